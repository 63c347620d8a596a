"""Tables rounded so that a SOG holds them in fewer bytes: to fewer different values.

A SOG has 16 bits for a position and 8 for most other numbers, more than pictures show.  What is rounded here lies on
levels of the format, so that it is written as it is.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.packing import from_smallest_three, smallest_three
from clsplat.formats.splats import MAX_LOG, logits, opacities, unit
from clsplat.quaternions import multiply

Floats = NDArray[np.floating]
SMALL = 25  # percentile of the sizes that steps of positions are compared with
LEVELS = 65535  # of a position, from 0
TINY = 2.0**-40  # levels, in the place of a size of 0
MOST_BITS = 8  # last bits of a position that are alike
_SIGNED = [turn for turn in product((0, 1, -1), repeat=4) if np.count_nonzero(turn) in (1, 2, 4)]
# rotations of the axes onto axes, [24, 4]; a quaternion and its negative are one
_TURNS = np.array([np.divide(turn, np.linalg.norm(turn)) for turn in _SIGNED if next(filter(None, turn)) > 0])


def rounded(values: Floats, step: float) -> NDArray[np.float32]:
    """Return values as multiples of a step."""
    return np.asarray(np.rint(values.astype(np.float64) / step) * step, np.float32)


def rounded_means(means: Floats, log_scales: Floats, share: float) -> NDArray[np.float32]:
    """Return positions [N, 3] in steps of at most `share` of the size that a quarter of the Gaussians do not reach.

    Steps are powers of two of the levels of a SOG, for each axis, so that low bits are alike.  The least position of an
    axis stays, and so does the greatest: they are the range that levels divide.  For training that follows: what a
    Gaussian weighs changes in it.
    """
    levels, low, level = _levels(means)
    bits = np.floor(np.log2(np.maximum(share * np.percentile(_sizes(means, log_scales), SMALL, axis=0) / level, 1)))
    step = np.exp2(np.minimum(bits, MOST_BITS))
    coarse = np.where(levels > 0, np.floor(levels / step) * step + step - 1, 0)
    return _positions(low + coarse * level)


def weighed_means(
    means: Floats, log_scales: Floats, log_weights: NDArray[np.float64], share: float
) -> NDArray[np.float32]:
    """Return positions [N, 3] in steps of about `share` of the size of each Gaussian, those of median weight.

    The step is as 1 / sqrt(weight) (sh_rounding.py): a power of two of the levels of a SOG.
    """
    levels, low, level = _levels(means)
    sizes = np.maximum(_sizes(means, log_scales) / level, TINY)
    wanted = np.log2(share * sizes) - log_weights[:, None] / 2
    step = np.exp2(np.clip(np.floor(wanted), 0, MOST_BITS))
    return _positions(low + np.clip(np.rint(levels / step) * step, 0, LEVELS) * level)


def _levels(means: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Positions in levels of a SOG, [N, 3]; the least of each axis, and how much a level is, [3], of logarithms."""
    wide = means.astype(np.float64)
    t = np.sign(wide) * np.log1p(np.abs(wide))
    low, span = t.min(axis=0), np.ptp(t, axis=0)
    level = np.where(span > 0, span, 1) / LEVELS
    return np.rint((t - low) / level), low, level


def _sizes(means: Floats, log_scales: Floats) -> NDArray[np.float64]:
    """Geometric means of standard deviations where the positions are logarithms, [N, 3]."""
    size = np.exp(np.minimum(log_scales.astype(np.float64).mean(axis=1, keepdims=True), MAX_LOG))
    return np.asarray(size / (1 + np.abs(means.astype(np.float64))))


def _positions(logarithms: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.asarray(np.sign(logarithms) * np.expm1(np.abs(logarithms)), np.float32)


def rounded_quats(quats: Floats, log_scales: Floats, step: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return quaternions [N, 4] on every `step`-th level of a SOG, and the scales [N, 3] that go with them.

    A Gaussian has 24 pairs of a rotation and scales, which differ in the names and signs of its axes.  That of the
    least angle is taken: the largest component is w then, and the others are small.
    """
    q, rows = unit(quats), np.arange(len(quats))
    along, taken = np.full(len(q), -1.0), np.zeros(len(q), np.intp)
    for number, (w, x, y, z) in enumerate(_TURNS):
        size = np.abs(q[:, 0] * w - q[:, 1] * x - q[:, 2] * y - q[:, 3] * z)
        taken, along = np.where(size > along, number, taken), np.maximum(size, along)
    largest, others = smallest_three(multiply(q, _TURNS[taken]))
    levels = np.clip(np.rint(255 * (others * 0.5**0.5 + 0.5) / step) * step, 0, 255)
    turned = from_smallest_three(largest, (levels / 255 - 0.5) * 2**0.5)
    return turned, log_scales[rows[:, None], _axes(_TURNS)[taken]].astype(np.float32)


def rounded_opacities(logit: Floats, step: int) -> NDArray[np.float32]:
    """Return the logits of opacities on every `step`-th of 255 levels, 1 at least."""
    levels = np.rint(255 * opacities(logit) / step) * step
    return logits(np.clip(levels, 1, 255) / 255)


def _axes(turns: NDArray[np.float64]) -> NDArray[np.intp]:
    """The axis that each axis comes from, [24, 3], by rotations of axes onto axes."""
    inverse = turns * [1, -1, -1, -1]
    axes = [multiply(multiply(turns, np.eye(4)[1 + axis]), inverse) for axis in range(3)]
    return np.stack([np.abs(image[:, 1:]).argmax(axis=1) for image in axes], axis=1)
