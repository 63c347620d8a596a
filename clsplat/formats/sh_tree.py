"""A palette of harmonics for neighbours: many vectors, each of few Gaussians that lie near each other.

Gaussians in their order, along a Morton curve, are divided into runs; a run is divided further where that lessens most
of what shows of the errors (tree-structured vector quantisation, Buzo et al. 1980), and the palette's vectors are the
means of the parts.  Labels of a run are near each other, which takes fewer bytes than vectors for all would save.  A
part's vector is rounded like the harmonics of an SPZ (sh_rounding.py): the less its Gaussians weigh, the coarser.
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.sh_rounding import rounded_rows, steps, usual_step, visible_form

RUN = 512  # Gaussians; a run of 256 takes fewer bytes and loses more
REPEATED = 0.75  # share of different vectors, at most, of harmonics that come from a palette
LLOYD_STEPS = 3  # of each division
AT_ONCE = 0.5  # share of the parts, at most, that are divided before their errors are computed again
TINY = 1e-300  # in the place of the weight of an empty part
LEVELS = 128  # to a coefficient of 1
LARGEST_STEP = 64.0  # levels
Floats = NDArray[np.float64]
Labels = NDArray[np.int64]


def tree_palette(
    rest: NDArray[np.float32], log_weights: Floats, entries: int, median_step: float
) -> tuple[Floats, Labels]:
    """Return vectors [E, 3 K], E at most `entries`, for harmonics [N, 3 K], and for each Gaussian its vector, [N].

    log_weights: of weights.py; median_step: of vectors, in LEVELS, in the median, for harmonics of the usual size.
    """
    run = len(rest) if _repeated(rest) else max(RUN, -(-len(rest) // entries))
    runs = np.arange(len(rest)) // run
    form, weights = visible_form(rest), np.exp2(log_weights)
    labels = _divided(_in_form(rest, form), weights, runs, entries)
    held = np.bincount(labels, weights)
    vectors = _sums(labels, weights, rest, len(held)) / held[:, None]
    log_held = np.log2(held)
    step = steps(log_held - np.median(log_held), usual_step(rest, median_step, median_step), LARGEST_STEP)
    first = np.zeros(len(held), np.int64)
    first[labels[::-1]] = np.arange(len(labels))[::-1]
    order = np.lexsort((first, step, runs[first]))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rounded = rounded_rows(LEVELS * vectors, step, form).astype(np.float64) / LEVELS
    return rounded[order], place[labels]


def _repeated(rest: NDArray[np.float32]) -> bool:
    """Whether many harmonics are repeated, by a palette for all that they had before: runs would repeat its vectors."""
    most = int(REPEATED * len(rest))
    return len(np.unique(rest[:, 0])) <= most and len(np.unique(rest, axis=0)) <= most


def _in_form(rest: NDArray[np.float32], form: Floats) -> NDArray[np.float32]:
    """Harmonics so turned and stretched that the form is the square of a distance, [N, 3 K]."""
    count = len(form)
    root = np.linalg.cholesky(form).astype(np.float32)  # e^T G e = |root^T e|^2
    table, found = rest.reshape(len(rest), count, 3), np.zeros((len(rest), count, 3), np.float32)
    for row in range(count):
        for column in range(row + 1):
            found[:, column] += root[row, column] * table[:, row]
    return found.reshape(rest.shape)


def _divided(points: NDArray[np.float32], weights: Floats, labels: Labels, entries: int) -> Labels:
    """Parts of points [N, c], where they begin as `labels` and are divided until there are so many."""
    labels, parts = labels.copy(), int(labels[-1]) + 1
    while parts < entries:
        held = np.maximum(np.bincount(labels, weights, minlength=parts), TINY)  # a half may be empty
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


def _halves(points: NDArray[np.float32], weights: Floats, own: Labels, beyond: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Lloyd's iteration with two means for each part: which points are of the second, from a first guess."""
    parts = int(own.max()) + 1
    for _ in range(LLOYD_STEPS):
        half = 2 * own + beyond
        held = np.maximum(np.bincount(half, weights, minlength=2 * parts), TINY)
        means = (_sums(half, weights, points, 2 * parts) / held[:, None]).reshape(parts, 2, -1)
        across = means[:, 1] - means[:, 0]
        middle = (across * (means[:, 0] + means[:, 1]) / 2).sum(axis=1)
        along = np.zeros(len(points))
        for column in range(points.shape[1]):
            along += points[:, column] * across[own, column]
        beyond = along > middle[own]
    return beyond


def _sums(labels: Labels, weights: Floats, points: NDArray[np.floating], parts: int) -> Floats:
    """Weighted sums of the points of each label, [parts, c], in the order of the points."""
    columns = [np.bincount(labels, weights * column, minlength=parts) for column in points.T]
    return np.stack(columns, axis=1)
