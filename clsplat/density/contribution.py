"""Scores of Gaussians by which they are pruned: what each does to the pictures, over pixels and views.

The contribution is the global significance of LightGaussian (Fan et al. 2024) without its factors.  Pixels that a mask
leaves out do not count, nor do those beyond the image's edge in its last tiles.
"""

from collections.abc import Callable, Iterable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.density.survey import SQUARE, WEIGHT, Look
from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.render.rasterizer import Rasterizer
from clsplat.views.photographs import Photograph

Score = Literal["weight", "sensitivity"]
Scoring = Callable[[Rasterizer, DeviceModel, Iterable[Photograph], Array], NDArray[np.float32]]


def contributions(
    rasterizer: Rasterizer, model: DeviceModel, photographs: Iterable[Photograph], background: Array
) -> NDArray[np.float32]:
    """Return the blend weights, alpha T, summed over photographs, [N]; 0 where a Gaussian is seen nowhere.

    background: [3]; the weights do not depend on it.
    """
    total = np.zeros(model.gaussians.count, np.float32)
    for photograph in photographs:
        total += Look.at(rasterizer, model, photograph, background).sum(WEIGHT)
    return total


def sensitivities(
    rasterizer: Rasterizer, model: DeviceModel, photographs: Iterable[Photograph], background: Array
) -> NDArray[np.float32]:
    """Return the squares of dI/dG summed over photographs and channels, [N]: I is a value of the image, G that of the
    Gaussian there, whose alpha is opacity times G (Speedy-Splat, Hanson et al. 2025).  background: [3].
    """
    total = np.zeros(model.gaussians.count, np.float32)
    for photograph in photographs:
        look = Look.at(rasterizer, model, photograph, background)
        for channel in range(3):
            total += look.sum(SQUARE, channel=channel)
    return total


SCORES: dict[Score, Scoring] = {"weight": contributions, "sensitivity": sensitivities}
