"""Codebooks of numbers and palettes of vectors: the same bits on every machine, with any number of threads.

Sums that depend on an order run in one; products of matrices, whose order is the library's, are of whole numbers that
float32 holds exactly, so that no order changes them.
"""

import numpy as np
from numpy.typing import NDArray

ENTRIES = 256  # of a codebook
CODEBOOK_ROUNDS, LLOYD_STEPS, PALETTE_ROUNDS = 4, 8, 10
BLOCK = 1024  # rows of points whose distances are in memory
SAMPLE = 8  # points that train one entry of a palette
LEVELS = 511  # whole numbers on each side of 0: sums of 45 products are below 2^24
TAIL = 1e-4  # share of values that may lie beyond LEVELS


def codebook(values: NDArray[np.floating], step: float | None = None) -> NDArray[np.float64]:
    """Return ENTRIES numbers, ascending, that stand for `values` with little squared error.

    Lloyd's iteration (1982) in rounds; between them two cells become one where that costs less than what the division
    of another gains.  Values that are at most ENTRIES different numbers are kept; the last is then repeated.  So are
    the multiples of `step` next to them, where the values are more.
    """
    ordered = np.sort(values.astype(np.float64) + 0.0, axis=None)  # -0 and 0 are one: which comes first is by chance
    for values in [ordered] + ([np.rint(ordered / step) * step] if step else []):
        different = np.unique(values)
        if len(different) <= ENTRIES:
            return np.concatenate([different, np.full(ENTRIES - len(different), different[-1])])
    cells = _Cells(ordered)
    cuts = _first_cuts(ordered)
    for _ in range(CODEBOOK_ROUNDS):
        for _ in range(LLOYD_STEPS):
            means = np.sort(cells.means(cuts))
            cuts[1:-1] = np.searchsorted(ordered, (means[1:] + means[:-1]) / 2)
        cuts = cells.exchanged(cuts)
    return np.sort(cells.means(cuts))


class _Cells:
    """Sorted values in consecutive cells, which are divided by the places `cuts`, [ENTRIES + 1]."""

    def __init__(self, ordered: NDArray[np.float64]) -> None:
        self.ordered, self.center = ordered, ordered[len(ordered) // 2]
        around = ordered - self.center
        self.sums, self.squares = _sums(around), _sums(np.square(around))

    def means(self, cuts: NDArray[np.int64]) -> NDArray[np.float64]:
        """The mean of each cell; of an empty one the value before it."""
        first, last = cuts[:-1], cuts[1:]
        mean: NDArray[np.float64] = (self.sums[last] - self.sums[first]) / np.maximum(last - first, 1) + self.center
        return np.where(last > first, mean, self.ordered[np.maximum(first, 1) - 1])

    def errors(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> NDArray[np.float64]:
        """The squared errors of cells."""
        total = self.sums[last] - self.sums[first]
        return np.asarray(self.squares[last] - self.squares[first] - np.square(total) / np.maximum(last - first, 1))

    def exchanged(self, cuts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Cuts after each pair of cells that is worth less apart than another cell is divided has been joined."""
        for _ in range(ENTRIES):
            own = self.errors(cuts[:-1], cuts[1:])
            joined = self.errors(cuts[:-2], cuts[2:]) - own[:-1] - own[1:]
            middle = np.clip(np.searchsorted(self.ordered, self.means(cuts)), cuts[:-1], cuts[1:])  # of empty cells too
            gain = own - self.errors(cuts[:-1], middle) - self.errors(middle, cuts[1:])
            worst = int(gain.argmax())
            joined[max(worst - 1, 0) : worst + 1] = np.inf  # of cells beside it
            cheap = int(joined.argmin())
            if gain[worst] <= joined[cheap] * (1 + 1e-9):
                break
            cuts = np.sort(np.append(np.delete(cuts, cheap + 1), middle[worst]))
        return cuts


def _sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of the values before each place, [N + 1], from the middle on: far ones cost no digits there."""
    middle = len(values) // 2
    before, after = np.cumsum(values[:middle][::-1])[::-1], np.cumsum(values[middle:])
    return np.concatenate([-before, [0.0], after])


def _first_cuts(ordered: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cells as dense as the cube root of the values' density (Panter and Dite 1951)."""
    edges = np.linspace(ordered[0], ordered[-1], 4 * ENTRIES + 1)
    places = np.searchsorted(ordered, edges)
    weight = np.concatenate([[0.0], np.cumsum(np.cbrt(np.diff(places)))])
    cuts = np.searchsorted(ordered, np.interp(np.linspace(0, weight[-1], ENTRIES + 1), weight, edges))
    cuts[0], cuts[-1] = 0, len(ordered)
    return cuts.astype(np.int64)


def nearest_entries(values: NDArray[np.floating], entries: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the index of the nearest entry for each value."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values).astype(np.uint8)


def palette(
    points: NDArray[np.float32], entries: int, weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return at most `entries` vectors, [E, c], that stand for points [N, c], and the vector of each point, [N].

    Lloyd's iteration on a share of the points, from evenly spaced ones; a vector without points gets one that is far
    from its own.  At most 45 components.  `weights`, [N], say how much errors count: a point is in that share as often
    as its weight says.  Points that are at most `entries` different ones stay.
    """
    if (kept := unique_points(points, entries)) is not None:
        return kept
    whole = _whole_numbers(points)
    chosen = _drawn(len(points), SAMPLE * entries, weights)
    sample, sample_whole = points[chosen].astype(np.float64), whole[chosen]
    starts = np.linspace(0, len(sample) - 1, entries).astype(np.int64)
    vectors, moved = sample[starts], sample_whole[starts]
    for _ in range(PALETTE_ROUNDS):
        labels, distance = _nearest_vectors(sample_whole, moved)
        held = np.bincount(labels, minlength=entries)
        sums = [np.bincount(labels, column, minlength=entries) for column in sample_whole.T]
        moved = np.rint(np.stack(sums, axis=1) / np.maximum(held, 1)[:, None]).astype(np.float32)
        empty = np.flatnonzero(held == 0)
        farthest = np.argsort(-distance, kind="stable")[: len(empty)]
        moved[empty] = sample_whole[farthest]
    for column in range(points.shape[1]):
        vectors[:, column] = np.bincount(labels, sample[:, column], minlength=entries) / np.maximum(held, 1)
    vectors[empty] = sample[farthest]
    return vectors, _nearest_vectors(whole, moved)[0]


def _nearest_vectors(
    points: NDArray[np.float32], vectors: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The nearest of the vectors [E, c] for each point [N, c], the first of equal ones, and half the squared distance.

    All are whole numbers from -LEVELS to LEVELS, so that every number is exact.
    """
    half = np.square(vectors).sum(axis=1) / 2
    labels, distance = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    space = np.empty((BLOCK, len(vectors)), np.float32)
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        apart = np.matmul(block, vectors.T, out=space[: len(block)])
        np.subtract(half, apart, out=apart)
        best = apart.argmin(axis=1)
        labels[start : start + BLOCK] = best
        distance[start : start + BLOCK] = apart[np.arange(len(block)), best] + np.square(block).sum(axis=1) / 2
    return labels, distance


def _drawn(count: int, most: int, weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """The places, ascending, of points that train a palette: evenly spaced ones by weight; by number without any."""
    most = min(count, most)
    if not weights.any():
        return np.linspace(0, count - 1, most).astype(np.int64)
    passed = np.cumsum(weights)
    return np.asarray(np.searchsorted(passed, (np.arange(most) + 0.5) / most * passed[-1]))


def _whole_numbers(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values as whole numbers from -LEVELS to LEVELS."""
    largest = robust_max(values) or np.float32(1)
    return np.asarray(np.rint(np.clip(values / largest, -1, 1) * np.float32(LEVELS)))


def unique_points(points: NDArray[np.float32], most: int) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Return the points that differ, in their order, and the label of each; None where more than `most` do."""
    if len(np.unique(points[:, 0])) > most:  # at once for most models
        return None
    found, first, labels = np.unique(points, axis=0, return_index=True, return_inverse=True)
    if len(found) > most:
        return None
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return found[order].astype(np.float64), place[labels.reshape(-1)]


def robust_max(values: NDArray[np.float32]) -> np.float32:
    """Return the size that all values but a share TAIL do not exceed; 0 of none."""
    size = np.abs(values).ravel()
    place = min(int((1 - TAIL) * size.size), size.size - 1)
    return np.float32(np.partition(size, place)[place] if size.size else 0)
