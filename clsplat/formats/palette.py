"""Compute codebooks of numbers and palettes of vectors, with the same bits on every machine and thread count.

Order-dependent sums run in a fixed order.  Matrix products, whose order the library chooses, only multiply whole
numbers that are exact in float32.
"""

import numpy as np
from numpy.typing import NDArray

ENTRIES = 256  # of a codebook
CODEBOOK_ROUNDS, LLOYD_STEPS, PALETTE_ROUNDS = 4, 8, 10
BLOCK = 1024  # rows whose distances are in memory at once
SAMPLE = 8  # training points per palette entry
LEVELS = 511  # whole numbers on each side of 0; sums of 45 products stay below 2^24
TAIL = 1e-4  # fraction of values that may be clipped to LEVELS


def codebook(values: NDArray[np.floating], step: float | None = None) -> NDArray[np.float64]:
    """Return ENTRIES numbers, ascending, that approximate `values` with little squared error.

    Rounds of Lloyd's iteration (1982); between rounds, two cells are merged if that costs less than splitting another
    cell gains.  If `values` has at most ENTRIES different numbers, these are returned exactly, with the last repeated;
    otherwise the same is tried for `values` rounded to multiples of `step`.
    """
    ordered = np.sort(values.astype(np.float64) + 0.0, axis=None)  # makes -0 equal to 0, whose order is undefined
    for values in [ordered] + ([np.rint(ordered / step) * step] if step else []):
        distinct = np.unique(values)
        if len(distinct) <= ENTRIES:
            return np.concatenate([distinct, np.full(ENTRIES - len(distinct), distinct[-1])])
    cells = _Cells(ordered)
    cuts = _first_cuts(ordered)
    for _ in range(CODEBOOK_ROUNDS):
        for _ in range(LLOYD_STEPS):
            means = np.sort(cells.means(cuts))
            cuts[1:-1] = np.searchsorted(ordered, (means[1:] + means[:-1]) / 2)
        cuts = cells.rebalance(cuts)
    return np.sort(cells.means(cuts))


class _Cells:
    """Sorted values in consecutive cells; cell i has the values from cuts[i] to cuts[i + 1]."""

    def __init__(self, ordered: NDArray[np.float64]) -> None:
        self.ordered, self.center = ordered, ordered[len(ordered) // 2]
        offsets = ordered - self.center
        self.sums, self.squares = _sums(offsets), _sums(np.square(offsets))

    def means(self, cuts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean of each cell, or the value before an empty cell."""
        first, last = cuts[:-1], cuts[1:]
        mean: NDArray[np.float64] = (self.sums[last] - self.sums[first]) / np.maximum(last - first, 1) + self.center
        return np.where(last > first, mean, self.ordered[np.maximum(first, 1) - 1])

    def errors(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the squared errors of cells."""
        total = self.sums[last] - self.sums[first]
        return np.asarray(self.squares[last] - self.squares[first] - np.square(total) / np.maximum(last - first, 1))

    def rebalance(self, cuts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Merge the cheapest pair of cells and split the worst cell, as long as that reduces the error."""
        for _ in range(ENTRIES):
            errors = self.errors(cuts[:-1], cuts[1:])
            loss = self.errors(cuts[:-2], cuts[2:]) - errors[:-1] - errors[1:]
            middle = np.clip(
                np.searchsorted(self.ordered, self.means(cuts)), cuts[:-1], cuts[1:]
            )  # clipped for empty cells
            gain = errors - self.errors(cuts[:-1], middle) - self.errors(middle, cuts[1:])
            split = int(gain.argmax())
            loss[max(split - 1, 0) : split + 1] = np.inf  # neighbors of the split cell
            merge = int(loss.argmin())
            if gain[split] <= loss[merge] * (1 + 1e-9):
                break
            cuts = np.sort(np.append(np.delete(cuts, merge + 1), middle[split]))
        return cuts


def _sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return prefix sums, [N + 1], relative to the middle, which keeps their precision there."""
    middle = len(values) // 2
    lower, upper = np.cumsum(values[:middle][::-1])[::-1], np.cumsum(values[middle:])
    return np.concatenate([-lower, [0.0], upper])


def _first_cuts(ordered: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return cells whose density is the cube root of that of the values (Panter and Dite 1951)."""
    edges = np.linspace(ordered[0], ordered[-1], 4 * ENTRIES + 1)
    positions = np.searchsorted(ordered, edges)
    weight = np.concatenate([[0.0], np.cumsum(np.cbrt(np.diff(positions)))])
    cuts = np.searchsorted(ordered, np.interp(np.linspace(0, weight[-1], ENTRIES + 1), weight, edges))
    cuts[0], cuts[-1] = 0, len(ordered)
    return cuts.astype(np.int64)


def nearest_entries(values: NDArray[np.floating], entries: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the index of the nearest entry for each value."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values).astype(np.uint8)


def palette(
    points: NDArray[np.float32], entries: int, weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return at most `entries` vectors, [E, c], that approximate points [N, c], and the label of each point, [N].

    Lloyd's iteration on a sample of the points, initialized with evenly spaced ones; a vector without points moves to
    the point with the largest error.  At most 45 components.  `weights`, [N], give the probability of each point in
    the sample.  At most `entries` different points are returned exactly.
    """
    if (exact := unique_points(points, entries)) is not None:
        return exact
    integers = _whole_numbers(points)
    rows = _sample_rows(len(points), SAMPLE * entries, weights)
    sample, integer_sample = points[rows].astype(np.float64), integers[rows]
    starts = np.linspace(0, len(sample) - 1, entries).astype(np.int64)
    vectors, centers = sample[starts], integer_sample[starts]
    for _ in range(PALETTE_ROUNDS):
        labels, distance = _nearest_vectors(integer_sample, centers)
        counts = np.bincount(labels, minlength=entries)
        sums = [np.bincount(labels, column, minlength=entries) for column in integer_sample.T]
        centers = np.rint(np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]).astype(np.float32)
        empty = np.flatnonzero(counts == 0)
        farthest = np.argsort(-distance, kind="stable")[: len(empty)]
        centers[empty] = integer_sample[farthest]
    for column in range(points.shape[1]):
        vectors[:, column] = np.bincount(labels, sample[:, column], minlength=entries) / np.maximum(counts, 1)
    vectors[empty] = sample[farthest]
    return vectors, _nearest_vectors(integers, centers)[0]


def _nearest_vectors(
    points: NDArray[np.float32], vectors: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the nearest vector of [E, c] for each point of [N, c], the first if equal, and half the squared distance.

    All are whole numbers from -LEVELS to LEVELS, so all results are exact.
    """
    half = np.square(vectors).sum(axis=1) / 2
    labels, distance = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    space = np.empty((BLOCK, len(vectors)), np.float32)
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        distances = np.matmul(block, vectors.T, out=space[: len(block)])
        np.subtract(half, distances, out=distances)
        best = distances.argmin(axis=1)
        labels[start : start + BLOCK] = best
        distance[start : start + BLOCK] = distances[np.arange(len(block)), best] + np.square(block).sum(axis=1) / 2
    return labels, distance


def _sample_rows(count: int, max_rows: int, weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return ascending rows of points that train a palette, evenly spaced by weight, or by row without weights."""
    max_rows = min(count, max_rows)
    if not weights.any():
        return np.linspace(0, count - 1, max_rows).astype(np.int64)
    total = np.cumsum(weights)
    return np.asarray(np.searchsorted(total, (np.arange(max_rows) + 0.5) / max_rows * total[-1]))


def _whole_numbers(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scale and round values to whole numbers from -LEVELS to LEVELS."""
    largest = robust_max(values) or np.float32(1)
    return np.asarray(np.rint(np.clip(values / largest, -1, 1) * np.float32(LEVELS)))


def unique_points(points: NDArray[np.float32], max_points: int) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Return the distinct points in order of appearance and the label of each point; None if more than `max_points`."""
    if len(np.unique(points[:, 0])) > max_points:  # decides at once for most models
        return None
    distinct, first, labels = np.unique(points, axis=0, return_index=True, return_inverse=True)
    if len(distinct) > max_points:
        return None
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return distinct[order].astype(np.float64), rank[labels.reshape(-1)]


def robust_max(values: NDArray[np.float32]) -> np.float32:
    """Return the absolute value that only a fraction TAIL of the values exceeds; 0 for no values."""
    size = np.abs(values).ravel()
    index = min(int((1 - TAIL) * size.size), size.size - 1)
    return np.float32(np.partition(size, index)[index] if size.size else 0)
