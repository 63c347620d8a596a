"""Tables rounded so that a SOG holds them in fewer bytes: to fewer different values.

A SOG has 16 bits for a position and 8 for most other numbers, more than pictures show.  What is rounded here lies on
levels of the format, so that it is written as it is.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsplat.core.harmonics import mean_basis
from clsplat.core.quaternions import multiply
from clsplat.formats.packing import from_smallest_three, smallest_three
from clsplat.formats.palette import LEVELS as PALETTE_LEVELS
from clsplat.formats.palette import robust_max
from clsplat.formats.splats import MAX_LOG, SH_C0, Parameters, unit

Floats = NDArray[np.floating]
LEVELS = 65535  # of a position, from 0
TINY = 2.0**-40  # levels, in the place of a size of 0
MOST_BITS = 8  # last bits of a position that are alike
_SIGNED = [turn for turn in product((0, 1, -1), repeat=4) if np.count_nonzero(turn) in (1, 2, 4)]
# rotations of the axes onto axes, [24, 4]; a quaternion and its negative are one
_TURNS = np.array([np.divide(turn, np.linalg.norm(turn)) for turn in _SIGNED if next(filter(None, turn)) > 0])


def round_to(values: Floats, step: float) -> NDArray[np.float32]:
    """Return values as multiples of a step."""
    return np.asarray(np.rint(values.astype(np.float64) / step) * step, np.float32)


def round_means(
    means: Floats, log_scales: Floats, log_weights: NDArray[np.float64], share: float
) -> NDArray[np.float32]:
    """Return positions [N, 3] in steps of about `share` of the size of each Gaussian, those of median weight.

    The step is as 1 / sqrt(weight) (see `quantization_steps`): a power of two of the levels of a SOG.
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


def round_quats(quats: Floats, log_scales: Floats, step: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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


def _axes(turns: NDArray[np.float64]) -> NDArray[np.intp]:
    """The axis that each axis comes from, [24, 3], by rotations of axes onto axes."""
    inverse = turns * [1, -1, -1, -1]
    axes = [multiply(multiply(turns, np.eye(4)[1 + axis]), inverse) for axis in range(3)]
    return np.stack([np.abs(image[:, 1:]).argmax(axis=1) for image in axes], axis=1)


# Harmonics rounded so that little of it shows, from the model alone.

ISOTROPIC = 0.02  # share of all directions alike beside those that the moments tell; 0.005 to 0.1 differ little
USUAL = 0.028  # root of the mean square of harmonics: fox after 7 000 steps; Lego has 0.037, the kitchen 0.043
ROWS = 1 << 15  # that are rounded at once


def quantization_steps(log_weights: NDArray[np.float64], median: float, most: float) -> NDArray[np.float32]:
    """Return a step for each Gaussian, [N]: a power of two, about `median` for the median weight, from 1 to `most`."""
    exponents = np.rint(np.log2(median) - log_weights / 2)
    return np.asarray(np.exp2(np.clip(exponents, 0, np.log2(most))), np.float32)


def usual_step(rest: Floats, step: float, most: float) -> float:
    """Return a step that is chosen for harmonics of the size USUAL, and for others in proportion, up to `most`."""
    size = float(np.sqrt(np.square(np.clip(rest, -1, 1), dtype=np.float64).mean())) if rest.size else 0.0
    return min(most, step * max(size / USUAL, 1e-3))


def visible_form(rest: Floats) -> NDArray[np.float64]:
    """Return G for harmonics [N, 3 K], as [K, K] with a trace of K, the same bits with any number of threads."""
    largest = robust_max(rest)
    count = rest.shape[1] // 3
    form = np.zeros((count, count))
    for start in range(0, len(rest) if largest else 0, ROWS):
        block = rest[start : start + ROWS].astype(np.float64) / largest
        whole = np.rint(PALETTE_LEVELS * np.clip(block, -1, 1)).reshape(-1, count, 3)
        for channel in range(3):
            form += whole[:, :, channel].T @ whole[:, :, channel]
    trace = np.trace(form)
    return (form * (count / trace) if trace else form) + ISOTROPIC * np.eye(count)


def compensate_base(base: Floats, errors: Floats, form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return coefficients of band 0, [N, 3], that take up what is the same everywhere of errors of the others.

    errors: what the others lack, [N, 3 K].
    """
    count = len(form)
    lacking = errors.reshape(len(errors), count, 3)
    change = np.zeros(base.shape)
    for k, mean in enumerate(mean_basis(form)):
        change += mean * lacking[:, k]
    return np.asarray(base + change / SH_C0, np.float32)


def round_sh(rest: Floats, steps: NDArray[np.float32], form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return harmonics [N, 3 K] as multiples of each Gaussian's step, whose errors show little by `form`, [K, K]."""
    count = len(form)
    # (G^-1) reversed = U^T U: row k of U tells how the coefficients after k take up an error of k
    inverse = np.linalg.inv(form[::-1, ::-1])
    feedback = np.linalg.cholesky(inverse).T.astype(np.float32)
    feedback /= np.diag(feedback)[:, None].copy()
    found = np.empty(rest.shape, np.float32)
    for start in range(0, len(rest), ROWS):
        part, step = rest[start : start + ROWS], steps[start : start + ROWS]
        left = np.ascontiguousarray(part.reshape(len(part), count, 3)[:, ::-1].transpose(1, 2, 0), np.float32)
        for k in range(count):
            wanted = left[k].copy()
            left[k] = np.rint(wanted / step) * step
            error = wanted - left[k]
            for later in range(k + 1, count):
                left[later] -= feedback[k, later] * error
        found[start : start + ROWS] = left[::-1].transpose(2, 0, 1).reshape(part.shape)
    return found


# A palette of many harmonics: parts of all Gaussians, divided again and again.

LLOYD_STEPS = 3  # of each division
AT_ONCE = 0.5  # share of the parts, at most, that are divided before their errors are computed again
TINY_WEIGHT = 1e-300  # in the place of the weight of an empty part
SH_LEVELS = 128  # to a coefficient of 1
LARGEST_STEP = 64.0  # levels
Labels = NDArray[np.int64]


def tree_palette(
    rest: NDArray[np.float32], log_weights: NDArray[np.float64], entries: int, median_step: float
) -> tuple[NDArray[np.float64], Labels]:
    """Return vectors [E, 3 K], E at most `entries`, for harmonics [N, 3 K], and for each Gaussian its vector, [N].

    log_weights: as `log_weights` returns them; median_step: of vectors, in LEVELS, in the median, for harmonics of the
    usual size.
    """
    form, weights = visible_form(rest), np.exp2(log_weights)
    labels = _divided(_in_form(rest, form), weights, entries)
    held = np.bincount(labels, weights)
    vectors = _sums(labels, weights, rest, len(held)) / held[:, None]
    log_held = np.log2(held)
    step = quantization_steps(log_held - np.median(log_held), usual_step(rest, median_step, median_step), LARGEST_STEP)
    first = np.zeros(len(held), np.int64)
    first[labels[::-1]] = np.arange(len(labels))[::-1]
    order = np.lexsort((first, step))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rounded = round_sh(SH_LEVELS * vectors, step, form).astype(np.float64) / SH_LEVELS
    return rounded[order], place[labels]


def _in_form(rest: NDArray[np.float32], form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Harmonics so turned and stretched that the form is the square of a distance, [N, 3 K]."""
    count = len(form)
    root = np.linalg.cholesky(form).astype(np.float32)  # e^T G e = |root^T e|^2
    table, found = rest.reshape(len(rest), count, 3), np.zeros((len(rest), count, 3), np.float32)
    for row in range(count):
        for column in range(row + 1):
            found[:, column] += root[row, column] * table[:, row]
    return found.reshape(rest.shape)


def _divided(points: NDArray[np.float32], weights: NDArray[np.float64], entries: int) -> Labels:
    """Parts of points [N, c], which are divided until there are so many."""
    labels, parts = np.zeros(len(points), np.int64), 1
    while parts < entries:
        held = np.maximum(np.bincount(labels, weights, minlength=parts), TINY_WEIGHT)  # a half may be empty
        mean = _sums(labels, weights, points, parts) / held[:, None]
        away = (points - mean[labels]).astype(np.float32)
        spread = _sums(labels, weights, np.square(away), parts)
        errors = np.where(np.bincount(labels, minlength=parts) > 1, spread.sum(axis=1), 0)
        most = min(entries - parts, -(-parts // round(1 / AT_ONCE)))
        chosen = np.argsort(-errors, kind="stable")[:most]
        chosen = chosen[errors[chosen] > 0]
        if not len(chosen):
            break
        new = np.full(parts, -1)
        new[chosen] = np.arange(len(chosen))
        rows = np.flatnonzero(new[labels] >= 0)
        own = new[labels[rows]]
        beyond = away[rows, spread.argmax(axis=1)[labels[rows]]] > 0
        beyond = _halves(points[rows], weights[rows], own, beyond)
        labels[rows[beyond]] = parts + own[beyond]
        parts += len(chosen)
    return np.unique(labels, return_inverse=True)[1].reshape(-1)


def _halves(
    points: NDArray[np.float32], weights: NDArray[np.float64], own: Labels, beyond: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Lloyd's iteration with two means for each part: which points are of the second, from a first guess."""
    parts = int(own.max()) + 1
    for _ in range(LLOYD_STEPS):
        half = 2 * own + beyond
        held = np.maximum(np.bincount(half, weights, minlength=2 * parts), TINY_WEIGHT)
        means = (_sums(half, weights, points, 2 * parts) / held[:, None]).reshape(parts, 2, -1)
        across = means[:, 1] - means[:, 0]
        middle = (across * (means[:, 0] + means[:, 1]) / 2).sum(axis=1)
        along = np.zeros(len(points))
        for column in range(points.shape[1]):
            along += points[:, column] * across[own, column]
        beyond = along > middle[own]
    return beyond


def _sums(
    labels: Labels, weights: NDArray[np.float64], points: NDArray[np.floating], parts: int
) -> NDArray[np.float64]:
    """Weighted sums of the points of each label, [parts, c], in the order of the points."""
    columns = [np.bincount(labels, weights * column, minlength=parts) for column in points.T]
    return np.stack(columns, axis=1)


# How much each Gaussian is estimated to contribute to pictures, from the model alone.

LARGEST = 10.0  # of the logarithms, on both sides of 0
# A sky is behind a gap: a distance within which are all but a few, and behind it many.  The spheres of
# clsplat/gaussians/conversion.py are 10 times as far as 97 % of the scene.  Their rows are found by it, not by their
# number: models are cropped, merged to fewer Gaussians, sorted and rounded afterwards.
GAP, INSIDE = 5.0, 0.97
FEWEST_INSIDE, FEWEST_BEHIND = 0.01, 0.05  # of all


def log_weights(p: Parameters, has_sky: bool = False) -> NDArray[np.float64]:
    """Return the binary logarithms of the weights, [N], of which the scene's median is 0; from -LARGEST to LARGEST.

    Scale-free: a model that is twice as large has the same.  has_sky: whether some Gaussians are a sky, which the
    median leaves out.
    """
    if not len(p["means"]):
        return np.zeros(0)
    means, scales = p["means"].astype(np.float64), np.sort(p["log_scales"].astype(np.float64), axis=1)
    squares = np.square(means - np.median(means, axis=0)).sum(axis=1)
    counted = before_gap(np.sqrt(squares)) if has_sky else np.ones(len(squares), np.bool_)
    squares += np.maximum(np.median(squares[counted]), 1e-30)
    opacity = -np.logaddexp(0, -p["logit_opacity"][:, 0].astype(np.float64))
    found = (opacity + (scales[:, 1] + scales[:, 2] - np.log(squares)) / 2) / np.log(2)
    return np.asarray(np.clip(found - np.median(found[counted]), -LARGEST, LARGEST))


def before_gap(distances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of these distances, [N], are not behind a gap, as those of a sky are; all where there is none.

    A sky lies around the scene, so that the median of all positions is in the scene's middle.
    """
    ordered, count = np.sort(distances), len(distances)
    within = np.arange(1, count + 1)
    inside = np.searchsorted(ordered, ordered / GAP, side="right")
    ends = (inside >= INSIDE * within) & (within >= FEWEST_INSIDE * count) & (count - within >= FEWEST_BEHIND * count)
    ends &= ordered > 0
    return distances <= ordered[ends][-1] / 2 if ends.any() else np.ones(count, np.bool_)
