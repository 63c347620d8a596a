"""Space cut into cells by the Gaussians of a coarse model: a kd-tree whose leaves hold equal shares of a weight.

Cells are half-open and the outer ones have no bounds, so that every point lies in exactly one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.density.box import Box
from clsplat.errors import DataError, amount

Floats = NDArray[np.float64]
CORE = (0.01, 0.99)  # quantiles of the weight between which a cell has its size: a few Gaussians lie far away
DIGITS = 9  # of a cut: more than single precision has


@dataclass(frozen=True)
class Cell:
    """A part of space, and the size of what lies in it."""

    box: Box
    size: Floats  # [3] scene units, between quantiles of its Gaussians

    def grown(self, share: float) -> Box:
        """Return the box with each of its bounds farther out by half of this share of its size."""
        step = 0.5 * share * self.size
        low = [None if one is None else _short(one - by) for one, by in zip(self.box.low, step, strict=True)]
        high = [None if one is None else _short(one + by) for one, by in zip(self.box.high, step, strict=True)]
        return Box(low=low, high=high)


def cells(means: NDArray[np.floating], weights: Floats, count: int) -> list[Cell]:
    """Return `count` cells, each with about the same share of the weights, [N], of Gaussians at `means`, [N, 3].

    A cell of several shares is cut across its longest side.  Raises DataError where so many are not to be had.
    """
    if not len(means):
        raise DataError("the model holds no Gaussians; expected one at least")
    weights = weights if weights.any() else np.ones(len(means))
    return _cut(means.astype(np.float64), weights, Box(), count)


def owners(means: NDArray[np.floating], found: list[Cell]) -> NDArray[np.int64]:
    """Return the number of the cell in which each of the points, [N, 3], lies, [N].

    Raises DataError for points that are not numbers, which lie in none.
    """
    owner = np.full(len(means), -1)
    for number, cell in enumerate(found):
        owner[cell.box.holds(means)] = number
    if (owner < 0).any():
        lost = f"{int((owner < 0).sum()):,} of {amount(len(owner), 'Gaussian')}"
        raise DataError(f"{lost} of the coarse model have places that are not finite; train it again")
    return owner


def quantile(values: Floats, weights: Floats, share: float) -> float:
    """Return the first of the values, [N], up to which, in ascending order, this share of the weights lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(order) - 1)]])


def _cut(means: Floats, weights: Floats, box: Box, count: int) -> list[Cell]:
    """The cells of a box, in which these Gaussians lie."""
    bounds = np.array([[quantile(means[:, axis], weights, share) for axis in range(3)] for share in CORE])
    size = bounds[1] - bounds[0]
    if count == 1:
        return [Cell(box, size)]
    axis, first = int(size.argmax()), count // 2
    place = _short(quantile(means[:, axis], weights, first / count))
    below = means[:, axis] < place
    if below.all() or not below.any() or not (weights[below].any() and weights[~below].any()):
        raise DataError(
            f"the model cannot be cut: {amount(len(means), 'Gaussian')} for {count} blocks; give fewer --blocks"
        )
    parts = ((below, "high", first), (~below, "low", count - first))
    return [
        cell
        for chosen, side, shares in parts
        for cell in _cut(means[chosen], weights[chosen], _with_bound(box, side, axis, place), shares)
    ]


def _with_bound(box: Box, side: str, axis: int, place: float) -> Box:
    bounds = list(getattr(box, side))
    bounds[axis] = place
    return box.model_copy(update={side: bounds})


def _short(value: float) -> float:
    """The value with as many digits as files show."""
    return float(f"{value:.{DIGITS}g}")
