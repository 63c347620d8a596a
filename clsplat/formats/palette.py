"""Compute codebooks of scalars and palettes of vectors, bit-identical on all machines and for any number of threads.

Order-dependent sums run in a fixed order.  The BLAS library chooses the order in which matrix products are summed, so
their factors are integers whose products and sums are exact in float32.
"""

import numpy as np
from numpy.typing import NDArray

ENTRIES = 256  # number of values in a codebook
CODEBOOK_ROUNDS, LLOYD_STEPS, PALETTE_ROUNDS = 4, 8, 10
BLOCK = 1024  # rows whose distances are in memory at once
SAMPLE = 8  # training points per palette entry
LEVELS = 511  # integers on each side of 0; sums of 45 products stay below 2^24
TAIL = 1e-4  # fraction of values that may be clipped to LEVELS


def fit_codebook(values: NDArray[np.floating], step: float | None = None) -> NDArray[np.float64]:
    """Return a codebook, [ENTRIES] in ascending order, that approximates `values` with a small squared error.

    If there are at most ENTRIES distinct values, these are returned exactly, and the last one is repeated.  Otherwise,
    the same is tried for `values` rounded to multiples of `step`.  If these also have too many distinct values,
    rounds of Lloyd's iteration (1982) compute the codebook.  Between rounds, pairs of cells are merged and other cells
    are split while this reduces the error.
    """
    sorted_values = np.sort(values.astype(np.float64) + 0.0, axis=None)  # -0 becomes 0: their order is undefined
    for candidates in [sorted_values] + ([np.rint(sorted_values / step) * step] if step else []):
        unique_values = np.unique(candidates)
        if len(unique_values) <= ENTRIES:
            return np.concatenate([unique_values, np.full(ENTRIES - len(unique_values), unique_values[-1])])
    cells = _Cells(sorted_values)
    cuts = _initial_cuts(sorted_values)
    for _ in range(CODEBOOK_ROUNDS):
        for _ in range(LLOYD_STEPS):
            means = np.sort(cells.means(cuts))
            cuts[1:-1] = np.searchsorted(sorted_values, (means[1:] + means[:-1]) / 2)
        cuts = cells.rebalance(cuts)
    return np.sort(cells.means(cuts))


class _Cells:
    """Sorted values in consecutive cells; cell i contains sorted_values[cuts[i] : cuts[i + 1]]."""

    def __init__(self, sorted_values: NDArray[np.float64]) -> None:
        self.sorted_values, self.center = sorted_values, sorted_values[len(sorted_values) // 2]
        offsets = sorted_values - self.center
        self.sums, self.squares = _prefix_sums(offsets), _prefix_sums(np.square(offsets))

    def means(self, cuts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean of each cell.  The mean of an empty cell is the value before it."""
        first, last = cuts[:-1], cuts[1:]
        mean: NDArray[np.float64] = (self.sums[last] - self.sums[first]) / np.maximum(last - first, 1) + self.center
        return np.where(last > first, mean, self.sorted_values[np.maximum(first, 1) - 1])

    def errors(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the squared error of each cell, which contains the values from index `first` to `last` - 1."""
        total = self.sums[last] - self.sums[first]
        return np.asarray(self.squares[last] - self.squares[first] - np.square(total) / np.maximum(last - first, 1))

    def rebalance(self, cuts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Repeatedly merge the cheapest pair of cells and split the worst cell while this reduces the error."""
        for _ in range(ENTRIES):
            errors = self.errors(cuts[:-1], cuts[1:])
            loss = self.errors(cuts[:-2], cuts[2:]) - errors[:-1] - errors[1:]
            middle = np.searchsorted(self.sorted_values, self.means(cuts))
            middle = np.clip(middle, cuts[:-1], cuts[1:])  # an empty cell's mean may be outside of it
            gain = errors - self.errors(cuts[:-1], middle) - self.errors(middle, cuts[1:])
            split = int(gain.argmax())
            loss[max(split - 1, 0) : split + 1] = np.inf  # pairs that include the split cell
            merge = int(loss.argmin())
            if gain[split] <= loss[merge] * (1 + 1e-9):
                break
            cuts = np.sort(np.append(np.delete(cuts, merge + 1), middle[split]))
        return cuts


def _prefix_sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return prefix sums, [N + 1].  They are 0 at the middle index, and therefore most precise around it."""
    middle = len(values) // 2
    lower, upper = np.cumsum(values[:middle][::-1])[::-1], np.cumsum(values[middle:])
    return np.concatenate([-lower, [0.0], upper])


def _initial_cuts(sorted_values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return cuts with a density proportional to the cube root of that of the values (Panter and Dite 1951)."""
    edges = np.linspace(sorted_values[0], sorted_values[-1], 4 * ENTRIES + 1)
    positions = np.searchsorted(sorted_values, edges)
    weight = np.concatenate([[0.0], np.cumsum(np.cbrt(np.diff(positions)))])
    cuts = np.searchsorted(sorted_values, np.interp(np.linspace(0, weight[-1], ENTRIES + 1), weight, edges))
    cuts[0], cuts[-1] = 0, len(sorted_values)
    return cuts.astype(np.int64)


def nearest_entries(values: NDArray[np.floating], entries: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the index of the nearest entry for each value."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values).astype(np.uint8)


def fit_palette(
    points: NDArray[np.float32], entry_count: int, weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return at most `entry_count` vectors, [E, c], that approximate points [N, c], and the label of each point, [N].

    If there are at most `entry_count` distinct points, these are returned exactly.  Otherwise, Lloyd's iteration runs
    on a sample of the points, and starts from evenly spaced rows.  A vector without points moves to the point with
    the largest error.  Points have at most 45 components.  weights: relative probabilities of sampling each point, [N].
    """
    if (exact_palette := unique_points(points, entry_count)) is not None:
        return exact_palette
    integers = _to_integers(points)
    rows = _sample_rows(len(points), SAMPLE * entry_count, weights)
    sample, integer_sample = points[rows].astype(np.float64), integers[rows]
    starts = np.linspace(0, len(sample) - 1, entry_count).astype(np.int64)
    vectors, centers = sample[starts], integer_sample[starts]
    for _ in range(PALETTE_ROUNDS):
        labels, distance = _nearest_vectors(integer_sample, centers)
        counts = np.bincount(labels, minlength=entry_count)
        sums = [np.bincount(labels, column, minlength=entry_count) for column in integer_sample.T]
        centers = np.rint(np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]).astype(np.float32)
        empty_entries = np.flatnonzero(counts == 0)
        farthest = np.argsort(-distance, kind="stable")[: len(empty_entries)]
        centers[empty_entries] = integer_sample[farthest]
    for column in range(points.shape[1]):
        vectors[:, column] = np.bincount(labels, sample[:, column], minlength=entry_count) / np.maximum(counts, 1)
    vectors[empty_entries] = sample[farthest]
    return vectors, _nearest_vectors(integers, centers)[0]


def _nearest_vectors(
    points: NDArray[np.float32], vectors: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of the vector, [E, c], nearest to each point, [N, c], and half its squared distance, both [N].

    The first vector wins ties.  Points and vectors are integers from -LEVELS to LEVELS, so all results are exact.
    """
    half_squares = np.square(vectors).sum(axis=1) / 2
    labels, distance = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    buffer = np.empty((BLOCK, len(vectors)), np.float32)
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        distances = np.matmul(block, vectors.T, out=buffer[: len(block)])
        np.subtract(half_squares, distances, out=distances)
        best = distances.argmin(axis=1)
        labels[start : start + BLOCK] = best
        distance[start : start + BLOCK] = distances[np.arange(len(block)), best] + np.square(block).sum(axis=1) / 2
    return labels, distance


def _sample_rows(count: int, max_rows: int, weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows to train a palette on, in ascending order, evenly spaced in cumulative weight.

    If all weights are 0, the rows are evenly spaced.
    """
    max_rows = min(count, max_rows)
    if not weights.any():
        return np.linspace(0, count - 1, max_rows).astype(np.int64)
    cumulative = np.cumsum(weights)
    return np.asarray(np.searchsorted(cumulative, (np.arange(max_rows) + 0.5) / max_rows * cumulative[-1]))


def _to_integers(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scale and round values to integers from -LEVELS to LEVELS."""
    max_value = robust_max(values) or np.float32(1)
    return np.asarray(np.rint(np.clip(values / max_value, -1, 1) * np.float32(LEVELS)))


def unique_points(points: NDArray[np.float32], max_points: int) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Return the distinct points in order of appearance, and each point's label; None for more than `max_points`."""
    if len(np.unique(points[:, 0])) > max_points:  # a fast test that suffices for most models
        return None
    unique_rows, first_rows, labels = np.unique(points, axis=0, return_index=True, return_inverse=True)
    if len(unique_rows) > max_points:
        return None
    order = np.argsort(first_rows)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return unique_rows[order].astype(np.float64), rank[labels.reshape(-1)]


def robust_max(values: NDArray[np.float32]) -> np.float32:
    """Return the (1 - TAIL) quantile of the absolute values, or 0 if there are no values."""
    magnitudes = np.abs(values).ravel()
    index = min(int((1 - TAIL) * magnitudes.size), magnitudes.size - 1)
    return np.float32(np.partition(magnitudes, index)[index] if magnitudes.size else 0)
