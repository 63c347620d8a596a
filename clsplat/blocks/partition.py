"""The partition of a scene by a coarse model: cells, the views and first Gaussians of each block, and the manifest."""

import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.cells import Cell, cells, owners
from clsplat.blocks.folder import MANIFEST, block_name
from clsplat.blocks.views import Membership, pairs_of, share_of
from clsplat.density.survey import Look
from clsplat.files import write_text
from clsplat.gaussians.model import Model
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Scene, View
from clsplat.training.memory import first_tables, plan
from clsplat.views.photographs import BUDGET_SHARE, Photographs

LOG = logging.getLogger("clsplat")
Bits = NDArray[np.bool_]
NEAR_CELL, GROWTH = 0.2, 0.2  # shares of a cell's size by which it is grown: for cameras, and for growth of Gaussians
SIGHT = 0.05  # share of a view's pixels


@dataclass(frozen=True)
class Block:
    """One part of the scene."""

    number: int
    cell: Cell
    gaussians: int  # of the coarse model that it owns
    pairs: float  # share of those of the whole
    start: Bits  # [N] the Gaussians that it starts from: its own, and those that its views see, or none
    views: list[dict[str, Any]]  # name, why, share of pixels
    memory: int  # bytes on the device at the beginning

    @property
    def name(self) -> str:
        """The name of its folder."""
        return block_name(self.number)

    def data(self) -> dict[str, Any]:
        """Return what the manifest says of it."""
        grown = {"cell": self.cell.box, "growth": self.cell.grown(GROWTH)}
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
        pairs = pairs_of(self._looks(self.views), total, int(self.device.tuning["TILE"]))
        found = cells(means, pairs, count)
        owner = owners(means, found)
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
            )
            for number, cell in enumerate(found)
        ]
        memory = self._memory(total, range(len(self.views)))
        return Partition(blocks, self.model, coarse, self.extent, memory, len(self.views))

    def _members(self, owner: NDArray[np.int64], found: list[Cell], sight: float) -> tuple[Membership, Bits]:
        """The views of each block, and the Gaussians that these see, or no view sees, [B, N]."""
        places = np.stack([view.position for view in self.views])
        inside = np.stack([cell.grown(NEAR_CELL).holds(places) for cell in found], axis=1)
        shares, seen = np.zeros(inside.shape), np.zeros((len(found), len(owner)), bool)
        for view, look in enumerate(self._looks(self.views)):
            shares[view], visible = share_of(look, owner, len(found))
            seen[Membership(shares[[view]], inside[[view]], sight).of_views[0]] |= visible
        members = Membership(shares, inside, sight)
        for view, block in np.argwhere(members.chosen & ~members.of_views):
            (look,) = self._looks([self.views[view]])
            seen[block] |= share_of(look, owner, len(found))[1]
        return members, seen | ~seen.any(axis=0)  # what is hidden from all views may come to light in any

    def _looks(self, views: Sequence[View]) -> Iterator[Look]:
        photographs = (self.photographs.get(view) for view in views)
        return Look.each(self._rasterizer, self._uploaded, photographs, self.photographs.background)

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
