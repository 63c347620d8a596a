"""Partition a scene by a coarse model into the cells, views, and initial Gaussians of blocks; write the manifest."""

import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, pluralize
from clsplat.core.files import write_text
from clsplat.density.control import Box
from clsplat.density.survey import WEIGHT, RenderedView
from clsplat.gaussians.model import Model
from clsplat.opencl.device import Device
from clsplat.photos.photographs import BUDGET_FRACTION, Photographs
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.memory import plan, table_widths
from clsplat.workflows.folder import MANIFEST, block_name

# Cells: the leaves of a kd-tree over the Gaussians of a coarse model, with equal sums of a weight.

Floats = NDArray[np.float64]
SIZE_QUANTILES = (0.01, 0.99)  # by weight; the extremes would follow the few Gaussians that are far away
DIGITS = 9  # significant digits of a cut; more than float32 has


@dataclass(frozen=True)
class PartitionCell:
    """A region of space and the size of its content."""

    box: Box
    size: Floats  # [3] scene units: distances between the SIZE_QUANTILES of the Gaussians' positions

    def extended(self, fraction: float) -> Box:
        """Return the box extended on each side by half of `fraction` of the cell's size."""
        margins = 0.5 * fraction * self.size
        low = [None if b is None else _round(b - margin) for b, margin in zip(self.box.low, margins, strict=True)]
        high = [None if b is None else _round(b + margin) for b, margin in zip(self.box.high, margins, strict=True)]
        return Box(low=low, high=high)


def split_space(means: NDArray[np.floating], weights: Floats, count: int) -> list[PartitionCell]:
    """Split space into `count` cells whose Gaussians have about the same sum of weights.

    means: [N, 3]; weights: [N].  Cells are split across their longest side.
    Raises DataError if the model cannot be split into `count` cells.
    """
    if not len(means):
        raise DataError("the model has no Gaussians to partition")
    weights = weights if weights.any() else np.ones(len(means))
    return _split_box(means.astype(np.float64), weights, Box(), count)


def assign_cells(means: NDArray[np.floating], cells: list[PartitionCell]) -> NDArray[np.int64]:
    """Return the index of the cell that contains each mean, [N].  means: [N, 3].

    Raises DataError for means that are not finite.
    """
    cell_index = np.full(len(means), -1)
    for number, cell in enumerate(cells):
        cell_index[cell.box.contains(means)] = number
    if (cell_index < 0).any():
        count = f"{int((cell_index < 0).sum()):,} of {pluralize(len(cell_index), 'Gaussian')}"
        raise DataError(f"{count} of the coarse model have positions that are not finite; train it again")
    return cell_index


def quantile(values: Floats, weights: Floats, fraction: float) -> float:
    """Return the weighted quantile of values, [N].

    It is the smallest value at which the cumulative weight reaches this fraction of the total.
    """
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, fraction * sums[-1])), len(order) - 1)]])


def _split_box(means: Floats, weights: Floats, box: Box, count: int) -> list[PartitionCell]:
    """Split a box and the Gaussians inside it recursively into `count` cells."""
    bounds = np.array(
        [[quantile(means[:, axis], weights, fraction) for axis in range(3)] for fraction in SIZE_QUANTILES]
    )
    size = bounds[1] - bounds[0]
    if count == 1:
        return [PartitionCell(box, size)]
    axis, count_below = int(size.argmax()), count // 2
    position = _round(quantile(means[:, axis], weights, count_below / count))
    is_below = means[:, axis] < position
    if is_below.all() or not is_below.any() or not (weights[is_below].any() and weights[~is_below].any()):
        raise DataError(f"{pluralize(len(means), 'Gaussian')} cannot be split into {count} blocks; use fewer --blocks")
    halves = ((is_below, "high", count_below), (~is_below, "low", count - count_below))
    return [
        cell
        for half, side, cells_in_half in halves
        for cell in _split_box(means[half], weights[half], _with_bound(box, side, axis, position), cells_in_half)
    ]


def _with_bound(box: Box, side: str, axis: int, position: float) -> Box:
    bounds = list(getattr(box, side))
    bounds[axis] = position
    return box.model_copy(update={side: bounds})


def _round(value: float) -> float:
    """Round a value to the digits stored in files."""
    return float(f"{value:.{DIGITS}g}")


# The views of a block: views whose cameras are in its cell, and views in which its Gaussians cover enough pixels.

Reason = Literal["inside", "coverage", "best"]


@dataclass(frozen=True)
class Membership:
    """The assignment of V training views to B blocks."""

    coverage: Floats  # [V, B] fraction of a view's pixels covered by a cell's Gaussians, by blending weight
    inside: NDArray[np.bool_]  # [V, B] whether the camera is in the cell
    min_coverage: float  # fraction of pixels above which a view belongs to a block

    @property
    def view_blocks(self) -> NDArray[np.bool_]:
        """Whether each view belongs to each block, [V, B]; always true for the block that covers most of the view."""
        is_best = np.arange(self.coverage.shape[1]) == self.coverage.argmax(axis=1)[:, None]
        return np.asarray(is_best | self.inside | (self.coverage > self.min_coverage))

    @property
    def assignment(self) -> NDArray[np.bool_]:
        """Whether each view is used to train each block, [V, B]: `view_blocks`, and at least one view per block."""
        blocks = self.view_blocks
        for block in np.flatnonzero(~blocks.any(axis=0)):
            blocks[self.coverage[:, block].argmax(), block] = True
        return blocks

    def reason(self, view: int, block: int) -> Reason:
        """Return the reason why a view belongs to a block: `inside`, `coverage`, or `best`."""
        if self.inside[view, block]:
            return "inside"
        return "coverage" if self.coverage[view, block] > self.min_coverage else "best"


def count_pairs(renders: Iterable[RenderedView], count: int, tile: int) -> Floats:
    """Estimate the number of (tile, Gaussian) pairs of each Gaussian over all views, [N], a proxy for training cost.

    count: N; tile: side in px.  The estimate uses the radius of each splat and is bounded by the image size.
    """
    total = np.zeros(count)
    for render in renders:
        camera, radius = render.photograph.camera, render.radius().astype(np.float64)
        tile_counts = [np.minimum(2 * radius / tile + 1, -(-side // tile)) for side in (camera.width, camera.height)]
        total += np.where(radius > 0, tile_counts[0] * tile_counts[1], 0)
    return total


def view_coverage(render: RenderedView, cell_index: NDArray[np.int64], blocks: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the fraction of a view's pixels covered by each block, [B], and whether each Gaussian is visible, [N].

    cell_index: the block of each Gaussian, [N].  Masked pixels do not count.
    """
    weight = render.sum(WEIGHT)
    pixels = max(int(render.counted_pixels().sum()), 1)
    return np.bincount(cell_index, weight.astype(np.float64), blocks) / pixels, weight > 0


LOG = logging.getLogger("clsplat")
Mask = NDArray[np.bool_]
NEAR_CELL, GROWTH = 0.2, 0.2  # fractions of a cell's size by which it is extended, for cameras and for densification
MIN_COVERAGE = 0.05  # fraction of a view's pixels


@dataclass(frozen=True)
class Block:
    """A block of a scene: its cell, views, and initial Gaussians."""

    number: int
    cell: PartitionCell
    gaussians: int  # number of the coarse model's Gaussians in its cell
    pairs: float  # fraction of all pairs
    start: Mask  # [N] initial Gaussians: in its cell, visible in its views, or visible in no view
    views: list[dict[str, Any]]  # name, why, and share: the fraction of pixels covered
    memory: int  # device memory at the start, bytes
    origin: NDArray[np.floating]  # [3] world coordinates of the origin of `cell`

    @property
    def name(self) -> str:
        """The name of the block's folder."""
        return block_name(self.number)

    @property
    def box(self) -> Box:
        """The cell in world coordinates, as in pipeline files."""
        return self.cell.box.shifted(-self.origin)

    @property
    def growth_box(self) -> Box:
        """The box in which densification is allowed, in world coordinates."""
        return self.cell.extended(GROWTH).shifted(-self.origin)

    def data(self) -> dict[str, Any]:
        """Return the block's entry in the manifest."""
        boxes = {"cell": self.box, "growth": self.growth_box}
        return {
            "name": self.name,
            **{name: box.model_dump() for name, box in boxes.items()},
            "gaussians": self.gaussians,
            "start": int(self.start.sum()),
            "pairs": self.pairs,
            "memory": self.memory,
            "views": self.views,
        }


@dataclass(frozen=True)
class Partition:
    """The blocks of a scene, the coarse model, and totals of the full scene."""

    blocks: list[Block]
    model: Model  # the coarse model
    coarse_digest: str  # SHA-256 of its file
    extent: float  # scene units
    memory: int  # device memory of the coarse model with all views, bytes
    views: int

    def data(self) -> dict[str, Any]:
        """Return the manifest as JSON data."""
        scene = {"gaussians": len(self.model), "views": self.views, "extent": self.extent, "memory": self.memory}
        return {"coarse": self.coarse_digest, **scene, "blocks": [block.data() for block in self.blocks]}

    def write(self, folder: Path) -> None:
        """Write the manifest and, next to it, the initial Gaussians of each block."""
        for block in self.blocks:
            self.model[block.start].save(folder / f"{block.name}.ply")
        write_text(folder / MANIFEST, json.dumps(self.data(), indent=1) + "\n")


class Partitioner:
    """Partitions a coarse model by the training views of a scene."""

    def __init__(self, model: Model, scene: Scene, device: Device, photographs: Photographs) -> None:
        self.model, self.device, self.photographs = model, device, photographs
        self.views: Sequence[View] = [view for view in scene.split("train") if view.downscale == scene.downscales[0]]
        self.extent = scene.extent
        self._rasterizer, self._uploaded = Rasterizer(device), model.upload(device)

    def partition(self, count: int, coarse_digest: str, min_coverage: float = MIN_COVERAGE) -> Partition:
        """Split the model into `count` blocks.  coarse_digest: SHA-256 of its file; min_coverage: as in `Membership`.

        Each view is rendered twice.  Raises DataError if the model cannot be split into that many blocks.
        """
        means, gaussian_count = self.model.means, len(self.model)
        pairs = count_pairs(self._render(self.views), gaussian_count, int(self.device.tuning["TILE"]))
        cells = split_space(means, pairs, count)
        cell_index = assign_cells(means, cells)
        membership, start_masks = self._assign_views(cell_index, cells, min_coverage)
        blocks = [
            Block(
                number,
                cell,
                int((cell_index == number).sum()),
                float(pairs[cell_index == number].sum() / (pairs.sum() or 1)),
                start := start_masks[number] | (cell_index == number),
                self._view_entries(membership, number),
                self._estimate_memory(int(start.sum()), np.flatnonzero(membership.assignment[:, number]).tolist()),
                self.model.origin,
            )
            for number, cell in enumerate(cells)
        ]
        memory = self._estimate_memory(gaussian_count, range(len(self.views)))
        return Partition(blocks, self.model, coarse_digest, self.extent, memory, len(self.views))

    def _assign_views(
        self, cell_index: NDArray[np.int64], cells: list[PartitionCell], min_coverage: float
    ) -> tuple[Membership, Mask]:
        """Return the views of each block, and a mask, [B, N], of Gaussians visible in its views or in no view."""
        positions = np.stack([view.position for view in self.views])
        is_inside = np.stack([cell.extended(NEAR_CELL).contains(positions) for cell in cells], axis=1)
        coverage, visible_in_block = np.zeros(is_inside.shape), np.zeros((len(cells), len(cell_index)), bool)
        for view, render in enumerate(self._render(self.views)):
            coverage[view], is_visible = view_coverage(render, cell_index, len(cells))
            visible_in_block[Membership(coverage[[view]], is_inside[[view]], min_coverage).view_blocks[0]] |= is_visible
        membership = Membership(coverage, is_inside, min_coverage)
        for view, block in np.argwhere(membership.assignment & ~membership.view_blocks):
            (render,) = self._render([self.views[view]])
            visible_in_block[block] |= view_coverage(render, cell_index, len(cells))[1]
        # Gaussians hidden from all views may become visible in any
        return membership, visible_in_block | ~visible_in_block.any(axis=0)

    def _render(self, views: Sequence[View]) -> Iterator[RenderedView]:
        photographs = (self.photographs.get(view) for view in views)
        return RenderedView.render_all(self._rasterizer, self._uploaded, photographs, self.photographs.background)

    def _view_entries(self, membership: Membership, block: int) -> list[dict[str, Any]]:
        """Return the manifest entries of a block's views, in scene order."""
        return [
            {
                "name": self.views[view].name,
                "why": membership.reason(view, block),
                "share": round(float(membership.coverage[view, block]), 4),
            }
            for view in np.flatnonzero(membership.assignment[:, block]).tolist()
        ]

    def _estimate_memory(self, gaussians: int, views: Sequence[int]) -> int:
        """Return the device memory for training, in bytes.  gaussians: initial number; views: indices of views."""
        cameras = [self.views[view].camera for view in views]
        sizes = [4 * camera.width * camera.height for camera in cameras]
        cached_bytes = min(int(BUDGET_FRACTION * self.device.info.memory), sum(sizes))
        motion = self.model.motion
        tables = table_widths(self.model.sh_degree, 0 if motion is None else motion.shape[1])
        return plan(self.device.info, tables, cached_bytes, max(sizes) // 4).required_bytes(gaussians)
