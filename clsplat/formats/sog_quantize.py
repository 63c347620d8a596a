"""Round tables to fewer distinct values, so that a SOG file compresses better.

SOG has 16 bits for a coordinate and 8 for most other values, which is more precise than the eye can see.  Values are
rounded to levels of the format, so that writing does not change them again.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsplat.core.harmonics import mean_basis
from clsplat.core.quaternions import multiply
from clsplat.formats.packing import from_smallest_three, smallest_three
from clsplat.formats.palette import LEVELS as PALETTE_LEVELS
from clsplat.formats.palette import robust_max
from clsplat.formats.splats import MAX_LOG, SH_C0, Parameters, normalize_quats

Floats = NDArray[np.floating]
LEVELS = 65535  # largest level of a coordinate
TINY = 2.0**-40  # levels; replaces a size of 0
MAX_ZERO_BITS = 8  # last bits of a position that may be zeroed
_SIGNED = [quat for quat in product((0, 1, -1), repeat=4) if np.count_nonzero(quat) in (1, 2, 4)]
# quaternions of the rotations that map axes onto axes, [24, 4]; q and -q are the same rotation
_ROTATIONS = np.array([np.divide(quat, np.linalg.norm(quat)) for quat in _SIGNED if next(filter(None, quat)) > 0])


def round_to(values: Floats, step: float) -> NDArray[np.float32]:
    """Round values to multiples of `step`."""
    return np.asarray(np.rint(values.astype(np.float64) / step) * step, np.float32)


def round_means(
    means: Floats, log_scales: Floats, log_weights: NDArray[np.float64], fraction: float
) -> NDArray[np.float32]:
    """Round positions, [N, 3], to multiples of a step for each Gaussian.

    The step is about `fraction` of the size for a Gaussian of median weight, and proportional to size / sqrt(weight).
    It is rounded to a power-of-two number of SOG levels.
    """
    levels, low, level = _to_levels(means)
    sizes = np.maximum(_sizes(means, log_scales) / level, TINY)
    bits = np.log2(fraction * sizes) - log_weights[:, None] / 2
    step = np.exp2(np.clip(np.floor(bits), 0, MAX_ZERO_BITS))
    return _to_positions(low + np.clip(np.rint(levels / step) * step, 0, LEVELS) * level)


def _to_levels(means: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Quantize positions: return levels, [N, 3], and the smallest logarithm and the level size of each axis, [3]."""
    positions = means.astype(np.float64)
    logarithms = np.sign(positions) * np.log1p(np.abs(positions))
    low, span = logarithms.min(axis=0), np.ptp(logarithms, axis=0)
    level = np.where(span > 0, span, 1) / LEVELS
    return np.rint((logarithms - low) / level), low, level


def _sizes(means: Floats, log_scales: Floats) -> NDArray[np.float64]:
    """Return the geometric mean of each Gaussian's scales, converted to the logarithmic space of positions, [N, 3]."""
    size = np.exp(np.minimum(log_scales.astype(np.float64).mean(axis=1, keepdims=True), MAX_LOG))
    return np.asarray(size / (1 + np.abs(means.astype(np.float64))))


def _to_positions(logarithms: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.asarray(np.sign(logarithms) * np.expm1(np.abs(logarithms)), np.float32)


def round_quats(quats: Floats, log_scales: Floats, step: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Round quaternions, [N, 4], to every `step`-th level of SOG; also return log scales, [N, 3], permuted to match.

    Axes can be permuted and flipped, so 24 pairs of rotation and scales represent the same Gaussian.  The pair with the
    smallest rotation angle is used: w is then the largest component, and the others are small.
    """
    q, rows = normalize_quats(quats), np.arange(len(quats))
    max_abs_w, rotations = np.full(len(q), -1.0), np.zeros(len(q), np.intp)
    for index, (w, x, y, z) in enumerate(_ROTATIONS):
        abs_w = np.abs(q[:, 0] * w - q[:, 1] * x - q[:, 2] * y - q[:, 3] * z)
        rotations, max_abs_w = np.where(abs_w > max_abs_w, index, rotations), np.maximum(abs_w, max_abs_w)
    largest_index, components = smallest_three(multiply(q, _ROTATIONS[rotations]))
    levels = np.clip(np.rint(255 * (components * 0.5**0.5 + 0.5) / step) * step, 0, 255)
    rounded_quats = from_smallest_three(largest_index, (levels / 255 - 0.5) * 2**0.5)
    return rounded_quats, log_scales[rows[:, None], _axes(_ROTATIONS)[rotations]].astype(np.float32)


def _axes(rotations: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the index of the axis onto which each rotation, [24, 4], maps each axis, [24, 3]."""
    inverse = rotations * [1, -1, -1, -1]
    axes = [multiply(multiply(rotations, np.eye(4)[1 + axis]), inverse) for axis in range(3)]
    return np.stack([np.abs(quats[:, 1:]).argmax(axis=1) for quats in axes], axis=1)


# Round SH with little visible error, from the model alone.

ISOTROPIC = 0.02  # weight of uniformly distributed directions in the moments; 0.005 to 0.1 give similar results
TYPICAL_RMS = 0.028  # RMS of the SH coefficients of fox after 7,000 steps; lego has 0.037, kitchen 0.043
ROWS = 1 << 15  # rows rounded at once


def quantization_steps(log_weights: NDArray[np.float64], median: float, max_step: float) -> NDArray[np.float32]:
    """Return power-of-two steps, [N], from 1 to `max_step`.  The step for the median weight is about `median`."""
    exponents = np.rint(np.log2(median) - log_weights / 2)
    return np.asarray(np.exp2(np.clip(exponents, 0, np.log2(max_step))), np.float32)


def scaled_step(rest: Floats, step: float, max_step: float) -> float:
    """Scale `step`, which suits SH with an RMS of TYPICAL_RMS, to the RMS of `rest`; return at most `max_step`."""
    size = float(np.sqrt(np.square(np.clip(rest, -1, 1), dtype=np.float64).mean())) if rest.size else 0.0
    return min(max_step, step * max(size / TYPICAL_RMS, 1e-3))


def visible_form(rest: Floats) -> NDArray[np.float64]:
    """Return a quadratic form that measures visible errors of SH, [N, 3 K]: a matrix, [K, K], with a trace of about K.

    The result is bit-identical for any number of threads.
    """
    max_value = robust_max(rest)
    count = rest.shape[1] // 3
    form = np.zeros((count, count))
    for start in range(0, len(rest) if max_value else 0, ROWS):
        block = rest[start : start + ROWS].astype(np.float64) / max_value
        levels = np.rint(PALETTE_LEVELS * np.clip(block, -1, 1)).reshape(-1, count, 3)
        for channel in range(3):
            form += levels[:, :, channel].T @ levels[:, :, channel]
    trace = np.trace(form)
    return (form * (count / trace) if trace else form) + ISOTROPIC * np.eye(count)


def compensate_base(base: Floats, errors: Floats, form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Correct the coefficients of band 0, [N, 3], for the error of the other bands, averaged over directions.

    errors: exact minus rounded coefficients of the other bands, [N, 3 K].
    """
    count = len(form)
    errors_by_band = errors.reshape(len(errors), count, 3)
    change = np.zeros(base.shape)
    for k, mean in enumerate(mean_basis(form)):
        change += mean * errors_by_band[:, k]
    return np.asarray(base + change / SH_C0, np.float32)


def round_sh(rest: Floats, steps: NDArray[np.float32], form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Round SH, [N, 3 K], to multiples of each Gaussian's step; later coefficients compensate for earlier errors.

    form: the metric to minimize, [K, K], from `visible_form`.
    """
    count = len(form)
    # with the metric G, (G^-1) reversed = U^T U: row k of U corrects an error in k in later coefficients
    inverse = np.linalg.inv(form[::-1, ::-1])
    feedback = np.linalg.cholesky(inverse).T.astype(np.float32)
    feedback /= np.diag(feedback)[:, None].copy()
    rounded_sh = np.empty(rest.shape, np.float32)
    for start in range(0, len(rest), ROWS):
        block, step = rest[start : start + ROWS], steps[start : start + ROWS]
        remaining = np.ascontiguousarray(block.reshape(len(block), count, 3)[:, ::-1].transpose(1, 2, 0), np.float32)
        for k in range(count):
            exact = remaining[k].copy()
            remaining[k] = np.rint(exact / step) * step
            error = exact - remaining[k]
            for later in range(k + 1, count):
                remaining[later] -= feedback[k, later] * error
        rounded_sh[start : start + ROWS] = remaining[::-1].transpose(2, 0, 1).reshape(block.shape)
    return rounded_sh


# Compute a large SH palette by splitting clusters of Gaussians recursively.

LLOYD_STEPS = 3  # iterations per split
SPLIT_FRACTION = 0.5  # largest fraction of clusters split before errors are recomputed
TINY_WEIGHT = 1e-300  # replaces the weight of an empty cluster
SH_LEVELS = 128  # levels in a coefficient of 1
MAX_STEP = 64.0  # levels
Labels = NDArray[np.int64]


def fit_tree_palette(
    rest: NDArray[np.float32], log_weights: NDArray[np.float64], max_entries: int, median_step: float
) -> tuple[NDArray[np.float64], Labels]:
    """Return at most `max_entries` palette vectors, [E, 3 K], for SH [N, 3 K], and the label of each Gaussian, [N].

    log_weights: [N], from `log_weights`.  median_step: median rounding step of the vectors, in units of
    1 / SH_LEVELS, for SH with an RMS of TYPICAL_RMS; it is scaled to the RMS of `rest`.
    """
    form, weights = visible_form(rest), np.exp2(log_weights)
    labels = _split_clusters(_to_euclidean(rest, form), weights, max_entries)
    totals = np.bincount(labels, weights)
    vectors = _label_sums(labels, weights, rest, len(totals)) / totals[:, None]
    log_totals = np.log2(totals)
    log_totals -= np.median(log_totals)
    step = quantization_steps(log_totals, scaled_step(rest, median_step, median_step), MAX_STEP)
    first_rows = np.zeros(len(totals), np.int64)
    first_rows[labels[::-1]] = np.arange(len(labels))[::-1]
    order = np.lexsort((first_rows, step))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    rounded_vectors = round_sh(SH_LEVELS * vectors, step, form).astype(np.float64) / SH_LEVELS
    return rounded_vectors[order], rank[labels]


def _to_euclidean(rest: NDArray[np.float32], form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Transform SH, [N, 3 K], so that squared Euclidean distances equal errors in the metric `form`, [K, K]."""
    count = len(form)
    root = np.linalg.cholesky(form).astype(np.float32)  # e^T G e = |root^T e|^2
    table, result = rest.reshape(len(rest), count, 3), np.zeros((len(rest), count, 3), np.float32)
    for row in range(count):
        for column in range(row + 1):
            result[:, column] += root[row, column] * table[:, row]
    return result.reshape(rest.shape)


def _split_clusters(points: NDArray[np.float32], weights: NDArray[np.float64], max_clusters: int) -> Labels:
    """Split points, [N, c], into at most `max_clusters` clusters, and return the label of each point, [N]."""
    labels, cluster_count = np.zeros(len(points), np.int64), 1
    while cluster_count < max_clusters:
        totals = np.maximum(np.bincount(labels, weights, minlength=cluster_count), TINY_WEIGHT)  # a half can be empty
        mean = _label_sums(labels, weights, points, cluster_count) / totals[:, None]
        offsets = (points - mean[labels]).astype(np.float32)
        spread = _label_sums(labels, weights, np.square(offsets), cluster_count)
        errors = np.where(np.bincount(labels, minlength=cluster_count) > 1, spread.sum(axis=1), 0)
        max_splits = min(max_clusters - cluster_count, -(-cluster_count // round(1 / SPLIT_FRACTION)))
        split_clusters = np.argsort(-errors, kind="stable")[:max_splits]
        split_clusters = split_clusters[errors[split_clusters] > 0]
        if not len(split_clusters):
            break
        split_index = np.full(cluster_count, -1)
        split_index[split_clusters] = np.arange(len(split_clusters))
        rows = np.flatnonzero(split_index[labels] >= 0)
        cluster = split_index[labels[rows]]
        is_second = offsets[rows, spread.argmax(axis=1)[labels[rows]]] > 0
        is_second = _bisect(points[rows], weights[rows], cluster, is_second)
        labels[rows[is_second]] = cluster_count + cluster[is_second]
        cluster_count += len(split_clusters)
    return np.unique(labels, return_inverse=True)[1].reshape(-1)


def _bisect(
    points: NDArray[np.float32], weights: NDArray[np.float64], cluster: Labels, is_second: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Split each cluster into two by Lloyd's iteration; return a mask of the points in second halves, [N]."""
    cluster_count = int(cluster.max()) + 1
    for _ in range(LLOYD_STEPS):
        half = 2 * cluster + is_second
        totals = np.maximum(np.bincount(half, weights, minlength=2 * cluster_count), TINY_WEIGHT)
        means = (_label_sums(half, weights, points, 2 * cluster_count) / totals[:, None]).reshape(cluster_count, 2, -1)
        axis = means[:, 1] - means[:, 0]
        threshold = (axis * (means[:, 0] + means[:, 1]) / 2).sum(axis=1)
        projection = np.zeros(len(points))
        for column in range(points.shape[1]):
            projection += points[:, column] * axis[cluster, column]
        is_second = projection > threshold[cluster]
    return is_second


def _label_sums(
    labels: Labels, weights: NDArray[np.float64], points: NDArray[np.floating], cluster_count: int
) -> NDArray[np.float64]:
    """Return the weighted sum of the points of each label, [clusters, c], added in the order of the points."""
    columns = [np.bincount(labels, weights * column, minlength=cluster_count) for column in points.T]
    return np.stack(columns, axis=1)


# Estimate how much each Gaussian contributes to renders, from the model alone.

MAX_LOG_WEIGHT = 10.0  # largest absolute value of the logarithms
# Sky Gaussians are recognized by a gap in distance: clsplat/gaussians/conversion.py places them 10 times as far away as
# 97 % of the scene.  Their row numbers do not help, because models are cropped, decimated, sorted, and rounded later.
GAP, INSIDE = 5.0, 0.97
MIN_INSIDE, MIN_BEHIND = 0.01, 0.05  # fractions of all Gaussians


def log_weights(p: Parameters, has_sky: bool = False) -> NDArray[np.float64]:
    """Return the base-2 logarithm of each Gaussian's weight in renders: [N], from -MAX_LOG_WEIGHT to MAX_LOG_WEIGHT.

    Their median is 0, and they do not depend on the scale of the model.  has_sky: whether some Gaussians represent a
    sky; these are excluded from the median.
    """
    if not len(p["means"]):
        return np.zeros(0)
    means, scales = p["means"].astype(np.float64), np.sort(p["log_scales"].astype(np.float64), axis=1)
    squares = np.square(means - np.median(means, axis=0)).sum(axis=1)
    is_scene = is_before_gap(np.sqrt(squares)) if has_sky else np.ones(len(squares), np.bool_)
    squares += np.maximum(np.median(squares[is_scene]), 1e-30)
    opacity = -np.logaddexp(0, -p["logit_opacity"][:, 0].astype(np.float64))
    logs = (opacity + (scales[:, 1] + scales[:, 2] - np.log(squares)) / 2) / np.log(2)
    return np.asarray(np.clip(logs - np.median(logs[is_scene]), -MAX_LOG_WEIGHT, MAX_LOG_WEIGHT))


def is_before_gap(distances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask, [N], of the distances below the gap that separates a sky, or of all distances without a gap."""
    sorted_distances, count = np.sort(distances), len(distances)
    counts = np.arange(1, count + 1)
    near_counts = np.searchsorted(sorted_distances, sorted_distances / GAP, side="right")
    has_gap = (near_counts >= INSIDE * counts) & (counts >= MIN_INSIDE * count) & (count - counts >= MIN_BEHIND * count)
    has_gap &= sorted_distances > 0
    return distances <= sorted_distances[has_gap][-1] / 2 if has_gap.any() else np.ones(count, np.bool_)
