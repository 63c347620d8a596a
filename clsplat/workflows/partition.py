"""Partition a scene by a coarse model: cells, views and initial Gaussians of each block, and the manifest."""

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
from clsplat.photos.photographs import BUDGET_SHARE, Photographs
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.memory import first_tables, plan
from clsplat.workflows.folder import MANIFEST, block_name

# Cells: the leaves of a kd-tree over the Gaussians of a coarse model, with equal shares of a weight.

Floats = NDArray[np.float64]
CORE = (0.01, 0.99)  # weight quantiles that define the size of a cell, because a few Gaussians are far away
DIGITS = 9  # of a cut; more than float32 has


@dataclass(frozen=True)
class PartitionCell:
    """A region of space and the size of its content."""

    box: Box
    size: Floats  # [3] scene units, between quantiles of its Gaussians

    def grown(self, share: float) -> Box:
        """Return the box extended on each side by half of this fraction of its size."""
        step = 0.5 * share * self.size
        low = [None if b is None else _short(b - by) for b, by in zip(self.box.low, step, strict=True)]
        high = [None if b is None else _short(b + by) for b, by in zip(self.box.high, step, strict=True)]
        return Box(low=low, high=high)


def cells(means: NDArray[np.floating], weights: Floats, count: int) -> list[PartitionCell]:
    """Return `count` cells, each with about the same share of the weights, [N], of Gaussians at `means`, [N, 3].

    Cells are split across their longest side.  Raises DataError if the model cannot be split into `count` cells.
    """
    if not len(means):
        raise DataError("the model has no Gaussians to partition")
    weights = weights if weights.any() else np.ones(len(means))
    return _cut(means.astype(np.float64), weights, Box(), count)


def assign_cells(means: NDArray[np.floating], found: list[PartitionCell]) -> NDArray[np.int64]:
    """Return the index of the cell that contains each point of [N, 3], [N].

    Raises DataError for points that are not finite.
    """
    owner = np.full(len(means), -1)
    for number, cell in enumerate(found):
        owner[cell.box.holds(means)] = number
    if (owner < 0).any():
        lost = f"{int((owner < 0).sum()):,} of {pluralize(len(owner), 'Gaussian')}"
        raise DataError(f"{lost} of the coarse model have positions that are not finite; train it again")
    return owner


def quantile(values: Floats, weights: Floats, share: float) -> float:
    """Return the weighted quantile of values, [N]: the smallest value that reaches this fraction of the weights."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(order) - 1)]])


def _cut(means: Floats, weights: Floats, box: Box, count: int) -> list[PartitionCell]:
    """Split a box with these Gaussians into cells."""
    bounds = np.array([[quantile(means[:, axis], weights, share) for axis in range(3)] for share in CORE])
    size = bounds[1] - bounds[0]
    if count == 1:
        return [PartitionCell(box, size)]
    axis, first = int(size.argmax()), count // 2
    cut = _short(quantile(means[:, axis], weights, first / count))
    below = means[:, axis] < cut
    if below.all() or not below.any() or not (weights[below].any() and weights[~below].any()):
        raise DataError(f"{pluralize(len(means), 'Gaussian')} cannot be split into {count} blocks; give fewer --blocks")
    parts = ((below, "high", first), (~below, "low", count - first))
    return [
        cell
        for chosen, side, shares in parts
        for cell in _cut(means[chosen], weights[chosen], _with_bound(box, side, axis, cut), shares)
    ]


def _with_bound(box: Box, side: str, axis: int, cut: float) -> Box:
    bounds = list(getattr(box, side))
    bounds[axis] = cut
    return box.model_copy(update={side: bounds})


def _short(value: float) -> float:
    """Round a value to the digits stored in files."""
    return float(f"{value:.{DIGITS}g}")


# The views of a block: those with cameras in its cell, and those of which it covers enough pixels.

Why = Literal["place", "sight", "best"]


@dataclass(frozen=True)
class Membership:
    """Which of V views belong to which of B blocks."""

    share: Floats  # [V, B] fraction of a view's pixels covered by a cell's Gaussians, by blending weight
    inside: NDArray[np.bool_]  # [V, B] whether the camera is in the cell
    sight: float  # fraction of pixels above which a view belongs to a block

    @property
    def view_blocks(self) -> NDArray[np.bool_]:
        """The blocks of each view, [V, B]; at least the one that it shows most of."""
        best = np.arange(self.share.shape[1]) == self.share.argmax(axis=1)[:, None]
        return np.asarray(best | self.inside | (self.share > self.sight))

    @property
    def chosen(self) -> NDArray[np.bool_]:
        """The blocks of each view, [V, B]; a block without views gets the view that shows most of it."""
        blocks = self.view_blocks
        for block in np.flatnonzero(~blocks.any(axis=0)):
            blocks[self.share[:, block].argmax(), block] = True
        return blocks

    def why(self, view: int, block: int) -> Why:
        """Return the reason why a view belongs to a block."""
        if self.inside[view, block]:
            return "place"
        return "sight" if self.share[view, block] > self.sight else "best"


def count_pairs(looks: Iterable[RenderedView], count: int, tile: int) -> Floats:
    """Return the number of (tile, Gaussian) pairs of `count` Gaussians over all views, [N], a proxy of training cost.

    It is estimated from the radius of each splat, bounded by the image size.
    """
    total = np.zeros(count)
    for look in looks:
        camera, radius = look.photograph.camera, look.radius().astype(np.float64)
        sides = [np.minimum(2 * radius / tile + 1, -(-side // tile)) for side in (camera.width, camera.height)]
        total += np.where(radius > 0, sides[0] * sides[1], 0)
    return total


def pixel_share(look: RenderedView, owner: NDArray[np.int64], blocks: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the fraction of a view's pixels covered by each block, [B], and which Gaussians are visible, [N].

    owner: the block of each Gaussian, [N].  Masked pixels do not count.
    """
    weight = look.sum(WEIGHT)
    pixels = max(int(look.counted().sum()), 1)
    return np.bincount(owner, weight.astype(np.float64), blocks) / pixels, weight > 0


LOG = logging.getLogger("clsplat")
Bits = NDArray[np.bool_]
NEAR_CELL, GROWTH = 0.2, 0.2  # fractions of a cell's size by which it is extended, for cameras and for densification
SIGHT = 0.05  # fraction of a view's pixels


@dataclass(frozen=True)
class Block:
    """One block of the scene."""

    number: int
    cell: PartitionCell
    gaussians: int  # of the coarse model that it owns
    pairs: float  # fraction of all pairs
    start: Bits  # [N] initial Gaussians: its own, those that its views see, and those that no view sees
    views: list[dict[str, Any]]  # name, why, and share of pixels
    memory: int  # device memory at the start, bytes
    origin: NDArray[np.floating]  # [3] world coordinates of the zero of `cell`

    @property
    def name(self) -> str:
        """The name of its folder."""
        return block_name(self.number)

    @property
    def box(self) -> Box:
        """The cell in world coordinates, as in pipeline files."""
        return self.cell.box.shifted(-self.origin)

    @property
    def growth(self) -> Box:
        """The box in which Gaussians grow, in world coordinates."""
        return self.cell.grown(GROWTH).shifted(-self.origin)

    def data(self) -> dict[str, Any]:
        """Return the block's entry in the manifest."""
        grown = {"cell": self.box, "growth": self.growth}
        return {
            "name": self.name,
            **{name: box.model_dump() for name, box in grown.items()},
            "gaussians": self.gaussians,
            "start": int(self.start.sum()),
            "pairs": self.pairs,
            "memory": self.memory,
            "views": self.views,
        }


@dataclass(frozen=True)
class Partition:
    """All blocks, and properties of the whole scene."""

    blocks: list[Block]
    model: Model  # the coarse one
    coarse: str  # SHA-256 of its file
    extent: float  # scene units
    memory: int  # device memory of the coarse model with all views, bytes
    views: int

    def data(self) -> dict[str, Any]:
        """Return the manifest."""
        whole = {"gaussians": len(self.model), "views": self.views, "extent": self.extent, "memory": self.memory}
        return {"coarse": self.coarse, **whole, "blocks": [block.data() for block in self.blocks]}

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

    def partition(self, count: int, coarse: str, sight: float = SIGHT) -> Partition:
        """Split the model into `count` blocks.  coarse: SHA-256 of its file; sight: as in `Membership`.

        Each view is rendered twice.  Raises DataError if the model cannot be split into that many blocks.
        """
        means, total = self.model.means, len(self.model)
        pairs = count_pairs(self._looks(self.views), total, int(self.device.tuning["TILE"]))
        found = cells(means, pairs, count)
        owner = assign_cells(means, found)
        members, seen = self._members(owner, found, sight)
        blocks = [
            Block(
                number,
                cell,
                int((owner == number).sum()),
                float(pairs[owner == number].sum() / (pairs.sum() or 1)),
                start := seen[number] | (owner == number),
                self._listed(members, number),
                self._memory(int(start.sum()), np.flatnonzero(members.chosen[:, number]).tolist()),
                self.model.origin,
            )
            for number, cell in enumerate(found)
        ]
        memory = self._memory(total, range(len(self.views)))
        return Partition(blocks, self.model, coarse, self.extent, memory, len(self.views))

    def _members(self, owner: NDArray[np.int64], found: list[PartitionCell], sight: float) -> tuple[Membership, Bits]:
        """Return the views of each block, and the Gaussians that they see or that no view sees, [B, N]."""
        positions = np.stack([view.position for view in self.views])
        inside = np.stack([cell.grown(NEAR_CELL).holds(positions) for cell in found], axis=1)
        shares, seen = np.zeros(inside.shape), np.zeros((len(found), len(owner)), bool)
        for view, look in enumerate(self._looks(self.views)):
            shares[view], visible = pixel_share(look, owner, len(found))
            seen[Membership(shares[[view]], inside[[view]], sight).view_blocks[0]] |= visible
        members = Membership(shares, inside, sight)
        for view, block in np.argwhere(members.chosen & ~members.view_blocks):
            (look,) = self._looks([self.views[view]])
            seen[block] |= pixel_share(look, owner, len(found))[1]
        return members, seen | ~seen.any(axis=0)  # Gaussians hidden from all views may become visible in any

    def _looks(self, views: Sequence[View]) -> Iterator[RenderedView]:
        photographs = (self.photographs.get(view) for view in views)
        return RenderedView.each(self._rasterizer, self._uploaded, photographs, self.photographs.background)

    def _listed(self, members: Membership, block: int) -> list[dict[str, Any]]:
        """Return the views of a block, in scene order, with reasons."""
        return [
            {
                "name": self.views[view].name,
                "why": members.why(view, block),
                "share": round(float(members.share[view, block]), 4),
            }
            for view in np.flatnonzero(members.chosen[:, block]).tolist()
        ]

    def _memory(self, gaussians: int, views: Sequence[int]) -> int:
        """Return the device memory, bytes, of a training that starts with these Gaussians and views."""
        cameras = [self.views[view].camera for view in views]
        sizes = [4 * camera.width * camera.height for camera in cameras]
        held = min(int(BUDGET_SHARE * self.device.info.memory), sum(sizes))
        motion = self.model.motion
        tables = first_tables(self.model.sh_degree, 0 if motion is None else motion.shape[1])
        return plan(self.device.info, tables, held, max(sizes) // 4).needed(gaussians)
