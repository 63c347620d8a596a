"""The partition of a scene by a coarse model: cells, the views and first Gaussians of each block, and the manifest."""

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

# Space cut into cells by the Gaussians of a coarse model: a kd-tree whose leaves hold equal shares of a weight.

Floats = NDArray[np.float64]
CORE = (0.01, 0.99)  # quantiles of the weight between which a cell has its size: a few Gaussians lie far away
DIGITS = 9  # of a cut: more than single precision has


@dataclass(frozen=True)
class PartitionCell:
    """A part of space, and the size of what lies in it."""

    box: Box
    size: Floats  # [3] scene units, between quantiles of its Gaussians

    def grown(self, share: float) -> Box:
        """Return the box with each of its bounds farther out by half of this share of its size."""
        step = 0.5 * share * self.size
        low = [None if one is None else _short(one - by) for one, by in zip(self.box.low, step, strict=True)]
        high = [None if one is None else _short(one + by) for one, by in zip(self.box.high, step, strict=True)]
        return Box(low=low, high=high)


def cells(means: NDArray[np.floating], weights: Floats, count: int) -> list[PartitionCell]:
    """Return `count` cells, each with about the same share of the weights, [N], of Gaussians at `means`, [N, 3].

    A cell of several shares is cut across its longest side.  Raises DataError where so many are not to be had.
    """
    if not len(means):
        raise DataError("the model holds no Gaussians; expected one at least")
    weights = weights if weights.any() else np.ones(len(means))
    return _cut(means.astype(np.float64), weights, Box(), count)


def assign_cells(means: NDArray[np.floating], found: list[PartitionCell]) -> NDArray[np.int64]:
    """Return the number of the cell in which each of the points, [N, 3], lies, [N].

    Raises DataError for points that are not numbers, which lie in none.
    """
    owner = np.full(len(means), -1)
    for number, cell in enumerate(found):
        owner[cell.box.holds(means)] = number
    if (owner < 0).any():
        lost = f"{int((owner < 0).sum()):,} of {pluralize(len(owner), 'Gaussian')}"
        raise DataError(f"{lost} of the coarse model have places that are not finite; train it again")
    return owner


def quantile(values: Floats, weights: Floats, share: float) -> float:
    """Return the first of the values, [N], up to which, in ascending order, this share of the weights lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(order) - 1)]])


def _cut(means: Floats, weights: Floats, box: Box, count: int) -> list[PartitionCell]:
    """The cells of a box, in which these Gaussians lie."""
    bounds = np.array([[quantile(means[:, axis], weights, share) for axis in range(3)] for share in CORE])
    size = bounds[1] - bounds[0]
    if count == 1:
        return [PartitionCell(box, size)]
    axis, first = int(size.argmax()), count // 2
    place = _short(quantile(means[:, axis], weights, first / count))
    below = means[:, axis] < place
    if below.all() or not below.any() or not (weights[below].any() and weights[~below].any()):
        raise DataError(
            f"the model cannot be cut: {pluralize(len(means), 'Gaussian')} for {count} blocks; give fewer --blocks"
        )
    parts = ((below, "high", first), (~below, "low", count - first))
    return [
        cell
        for chosen, side, shares in parts
        for cell in _cut(means[chosen], weights[chosen], _with_bound(box, side, axis, place), shares)
    ]


def _with_bound(box: Box, side: str, axis: int, place: float) -> Box:
    bounds = list(getattr(box, side))
    bounds[axis] = place
    return box.model_copy(update={side: bounds})


def _short(value: float) -> float:
    """The value with as many digits as files show."""
    return float(f"{value:.{DIGITS}g}")


# Which views a block is trained on: those that stand in its cell, and those of which it makes a share.

Why = Literal["place", "sight", "best"]


@dataclass(frozen=True)
class Membership:
    """Which of V views belong to which of B blocks."""

    share: Floats  # [V, B] of a view's pixels that the Gaussians of a cell make, by their blending weight
    inside: NDArray[np.bool_]  # [V, B] whether its camera stands in the cell
    sight: float  # share above which a view belongs to a block

    @property
    def view_blocks(self) -> NDArray[np.bool_]:
        """The blocks of each view, [V, B]: one at least, that of which it shows most."""
        best = np.arange(self.share.shape[1]) == self.share.argmax(axis=1)[:, None]
        return np.asarray(best | self.inside | (self.share > self.sight))

    @property
    def chosen(self) -> NDArray[np.bool_]:
        """The same, with the view that shows most of it for a block that has none."""
        found = self.view_blocks
        for block in np.flatnonzero(~found.any(axis=0)):
            found[self.share[:, block].argmax(), block] = True
        return found

    def why(self, view: int, block: int) -> Why:
        """Return the reason for which a view belongs to a block."""
        if self.inside[view, block]:
            return "place"
        return "sight" if self.share[view, block] > self.sight else "best"


def count_pairs(looks: Iterable[RenderedView], count: int, tile: int) -> Floats:
    """Return the (tile, Gaussian) pairs of N = `count` Gaussians over views, [N]: what their training costs.

    It is an estimate by the radius of a splat, which an image's sides bound.
    """
    total = np.zeros(count)
    for look in looks:
        camera, radius = look.photograph.camera, look.radius().astype(np.float64)
        sides = [np.minimum(2 * radius / tile + 1, -(-side // tile)) for side in (camera.width, camera.height)]
        total += np.where(radius > 0, sides[0] * sides[1], 0)
    return total


def pixel_share(look: RenderedView, owner: NDArray[np.int64], blocks: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the share of a view's pixels that the Gaussians of each block make, [B], and which are seen, [N].

    owner: the block of each Gaussian, [N].  Pixels that a mask leaves out do not count.
    """
    weight = look.sum(WEIGHT)
    pixels = max(int(look.counted().sum()), 1)
    return np.bincount(owner, weight.astype(np.float64), blocks) / pixels, weight > 0


LOG = logging.getLogger("clsplat")
Bits = NDArray[np.bool_]
NEAR_CELL, GROWTH = 0.2, 0.2  # shares of a cell's size by which it is grown: for cameras, and for growth of Gaussians
SIGHT = 0.05  # share of a view's pixels


@dataclass(frozen=True)
class Block:
    """One part of the scene."""

    number: int
    cell: PartitionCell
    gaussians: int  # of the coarse model that it owns
    pairs: float  # share of those of the whole
    start: Bits  # [N] the Gaussians that it starts from: its own, and those that its views see, or none
    views: list[dict[str, Any]]  # name, why, share of pixels
    memory: int  # bytes on the device at the beginning
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
        """Return what the manifest says of it."""
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
    """All blocks, and what the whole scene is."""

    blocks: list[Block]
    model: Model  # the coarse one
    coarse: str  # SHA-256 of its file
    extent: float  # scene units
    memory: int  # bytes on the device of the coarse model with all views
    views: int

    def data(self) -> dict[str, Any]:
        """Return the manifest."""
        whole = {"gaussians": len(self.model), "views": self.views, "extent": self.extent, "memory": self.memory}
        return {"coarse": self.coarse, **whole, "blocks": [block.data() for block in self.blocks]}

    def write(self, folder: Path) -> None:
        """Write the manifest and, beside it, the Gaussians from which each block starts."""
        for block in self.blocks:
            self.model[block.start].save(folder / f"{block.name}.ply")
        write_text(folder / MANIFEST, json.dumps(self.data(), indent=1) + "\n")


class Partitioner:
    """A coarse model at the training views of a scene."""

    def __init__(self, model: Model, scene: Scene, device: Device, photographs: Photographs) -> None:
        self.model, self.device, self.photographs = model, device, photographs
        self.views: Sequence[View] = [view for view in scene.split("train") if view.downscale == scene.downscales[0]]
        self.extent = scene.extent
        self._rasterizer, self._uploaded = Rasterizer(device), model.upload(device)

    def partition(self, count: int, coarse: str, sight: float = SIGHT) -> Partition:
        """Cut the model into `count` blocks.  coarse: SHA-256 of its file; sight: share of pixels of Membership.

        Each view is rendered twice.  Raises DataError where so many blocks are not to be had.
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
        """The views of each block, and the Gaussians that these see, or no view sees, [B, N]."""
        places = np.stack([view.position for view in self.views])
        inside = np.stack([cell.grown(NEAR_CELL).holds(places) for cell in found], axis=1)
        shares, seen = np.zeros(inside.shape), np.zeros((len(found), len(owner)), bool)
        for view, look in enumerate(self._looks(self.views)):
            shares[view], visible = pixel_share(look, owner, len(found))
            seen[Membership(shares[[view]], inside[[view]], sight).view_blocks[0]] |= visible
        members = Membership(shares, inside, sight)
        for view, block in np.argwhere(members.chosen & ~members.view_blocks):
            (look,) = self._looks([self.views[view]])
            seen[block] |= pixel_share(look, owner, len(found))[1]
        return members, seen | ~seen.any(axis=0)  # what is hidden from all views may come to light in any

    def _looks(self, views: Sequence[View]) -> Iterator[RenderedView]:
        photographs = (self.photographs.get(view) for view in views)
        return RenderedView.each(self._rasterizer, self._uploaded, photographs, self.photographs.background)

    def _listed(self, members: Membership, block: int) -> list[dict[str, Any]]:
        """The views of a block, in the order of the scene, with reasons."""
        return [
            {
                "name": self.views[view].name,
                "why": members.why(view, block),
                "share": round(float(members.share[view, block]), 4),
            }
            for view in np.flatnonzero(members.chosen[:, block]).tolist()
        ]

    def _memory(self, gaussians: int, views: Sequence[int]) -> int:
        """Bytes on the device of a training that begins with so many Gaussians and these views."""
        cameras = [self.views[view].camera for view in views]
        sizes = [4 * camera.width * camera.height for camera in cameras]
        held = min(int(BUDGET_SHARE * self.device.info.memory), sum(sizes))
        motion = self.model.motion
        tables = first_tables(self.model.sh_degree, 0 if motion is None else motion.shape[1])
        return plan(self.device.info, tables, held, max(sizes) // 4).needed(gaussians)
