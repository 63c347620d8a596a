"""The tree of a streamed SOG: boxes that are halved until they are small, over the splats of all levels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.packing import morton_order
from clsplat.formats.splats import Parameters, unit

MAX_LOG_SCALE = 80.0  # of a box: JSON has no infinity
Floats = NDArray[np.float64]
Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Limits:
    """What a leaf holds at most: numbers of PlayCanvas."""

    splats: int = 512 * 1024  # of all levels; and a file no more than these and one leaf's
    extent: float = 16.0  # scene units, of the longest side of its means' box
    few: int = 1024  # splats, which are not divided for their extent


@dataclass(frozen=True)
class Node:
    """A box, and two halves, or the rows of its splats by level, each along a Morton curve."""

    low: Floats  # [3] scene units
    high: Floats
    children: tuple["Node", ...] = ()
    rows: tuple[Rows, ...] = ()

    def leaves(self) -> Iterator["Node"]:
        """All leaves, from left to right."""
        if not self.children:
            yield self
        for child in self.children:
            yield from child.leaves()


def tree(levels: Sequence[Parameters], limits: Limits) -> Node:
    """Return the tree of levels, the finest first, none without splats."""
    means = np.concatenate([level["means"] for level in levels]).astype(np.float64)
    reach = np.concatenate([half_boxes(level) for level in levels])
    starts = np.cumsum([0, *(len(level["means"]) for level in levels)])

    def node(rows: Rows) -> Node:
        span = np.ptp(means[rows], axis=0)
        if len(rows) > limits.splats or (span.max() > limits.extent and len(rows) > limits.few):
            ordered = rows[np.argsort(means[rows, int(span.argmax())], kind="stable")]
            halves = node(ordered[: len(rows) // 2]), node(ordered[len(rows) // 2 :])
            low = np.minimum(*(half.low for half in halves))
            return Node(low, np.maximum(*(half.high for half in halves)), halves)
        low, high = (means[rows] - reach[rows]).min(axis=0), (means[rows] + reach[rows]).max(axis=0)
        return Node(low, high, rows=tuple(by_level(np.sort(rows))))

    def by_level(rows: Rows) -> Iterator[Rows]:
        for own, start in zip(np.split(rows, np.searchsorted(rows, starts[1:-1])), starts, strict=False):
            yield own[morton_order(means[own])] - start

    return node(np.arange(len(means)))


def half_boxes(level: Parameters) -> Floats:
    """Return half the sides of the boxes around turned boxes of one standard deviation, [N, 3] scene units."""
    from scipy.spatial.transform import Rotation

    turned = np.abs(Rotation.from_quat(np.roll(unit(level["quats"]), -1, axis=1)).as_matrix())
    scales = np.exp(np.minimum(level["log_scales"].astype(np.float64), MAX_LOG_SCALE))
    half: Floats = np.einsum("nij,nj->ni", turned, scales)
    return half
