"""The blended inverse depth, its gradient, and the loss of depths that are known at some pixels.

D = Σ w / z with z the depths of the means: the first channel of an image of splats coloured 1/z before black.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.blending import blend, blend_backward
from clsplat.conformance.reference.kinds import SplatGradients, Splats, Thresholds

Floats = NDArray[Any]
BLACK = np.zeros(3)


def _painted(splats: Splats) -> Splats:
    inverse = np.where(splats.visible, 1 / np.where(splats.visible, splats.depth, 1), 0)
    return replace(splats, colour=np.stack([inverse, *np.zeros((2, len(inverse)))], axis=1))


def inverse_depth(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> Floats:
    """D, [H,W]."""
    image, _, _ = blend(_painted(splats), width, height, BLACK, thresholds)
    return np.asarray(image[0])


def inverse_depth_backward(
    splats: Splats, width: int, height: int, grad: Floats, thresholds: Thresholds = Thresholds()
) -> tuple[SplatGradients, Floats]:
    """Gradients of the splats, whose colours have none, and dL/dz, [N]; grad: dL/dD, [H,W]."""
    planes = np.stack([grad, *np.zeros((2, *grad.shape))])
    found = blend_backward(_painted(splats), width, height, BLACK, planes, thresholds)
    by_depth = -found.colour[:, 0] * _painted(splats).colour[:, 0] ** 2
    return found._replace(colour=0 * found.colour), by_depth


def inverse_depth_loss(
    plane: Floats, places: tuple[Floats, Floats], targets: Floats, weights: Floats
) -> tuple[Floats, Floats]:
    """The terms q |D - 1/z| at the places (rows, columns), [K], and the gradient of their sum, [H,W]."""
    difference = plane[places] - targets
    gradient = np.zeros(plane.shape)
    gradient[places] = weights * np.sign(difference)
    return weights * np.abs(difference), gradient
