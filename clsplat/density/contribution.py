"""What Gaussians do to the pictures, over pixels and views, and pruning by it.

The contribution is the global significance of LightGaussian (Fan et al. 2024) without its factors.  Pixels that a mask
leaves out do not count, nor do those beyond the image's edge in its last tiles.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.density.control import Change
from clsplat.density.survey import SQUARE, WEIGHT, Look
from clsplat.gaussians.tables import Gaussians

Score = Literal["weight", "sensitivity"]
Scoring = Callable[[Iterable[Look], int], NDArray[np.float32]]


@dataclass(frozen=True)
class Weights:
    """What each Gaussian is in some views."""

    total: NDArray[Any]  # [N] blend weight, alpha T, summed over all pixels; 0 where it is seen nowhere
    views: NDArray[np.int64]  # [N] in which it is useful; 0 where that was not asked for


def weights(looks: Iterable[Look], count: int, of_view: float | None = None, dtype: DTypeLike = np.float64) -> Weights:
    """Return the weights of N = `count` Gaussians, added in the order of the views.

    of_view: the share of a view's weight that is made by what is useful in it, the largest first; None: not counted.
    dtype: of the total.
    """
    total, views = np.zeros(count, dtype), np.zeros(count, np.int64)
    for look in looks:
        weight = look.sum(WEIGHT)
        total += weight
        if of_view is not None:
            views += largest_of(weight.astype(np.float64), of_view)
    return Weights(total, views)


def largest_of(weight: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Return the fewest Gaussians, [N], that make this share of the weight; those without weight are none of them."""
    order = np.argsort(-weight, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    found = np.zeros(len(weight), bool)
    found[order] = (before < share * weight.sum()) & (weight[order] > 0)
    return found


def contributions(looks: Iterable[Look], count: int) -> NDArray[np.float32]:
    """Return the blend weights, alpha T, summed over pixels and views, [N]; single precision decides near ties."""
    return weights(looks, count, dtype=np.float32).total


def sensitivities(looks: Iterable[Look], count: int) -> NDArray[np.float32]:
    """Return the squares of dI/dG summed over views and channels, [N]: I is a value of the image, G that of the
    Gaussian there, whose alpha is opacity times G (Speedy-Splat, Hanson et al. 2025).
    """
    total = np.zeros(count, np.float32)
    for look in looks:
        for channel in range(3):
            total += look.sum(SQUARE, channel=channel)
    return total


SCORES: dict[Score, Scoring] = {"weight": contributions, "sensitivity": sensitivities}


def best(score: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the places of the `count` largest scores, ascending; of equal ones the first."""
    return np.sort(np.argsort(-score, kind="stable")[:count])


def keep(gaussians: Gaussians, kept: NDArray[np.int64], cause: str) -> Change:
    """Remove all Gaussians but those in some rows, ascending.  cause: a name of what chose them."""
    before = gaussians.count
    source = gaussians.device.upload(kept.astype(np.uint32))
    gaussians.rearrange(source, gaussians.device.zeros(len(kept), np.uint32), len(kept))
    return Change(before, len(kept), {cause: before - len(kept)}, {})
