"""Offload the SH bands above 0 and their moments to host memory.

They take 540 of the 708 bytes of a Gaussian of SH degree 3 with its moments.  Blocks have LANES rows.  Slots on
the device (cl_kernels/slots.h) store the blocks that are visible in a view, in row order.  These blocks are uploaded
before the view is rendered, and downloaded before the next view.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.structs import GaussianTables
from clsplat.opencl.device import Array

NO_SLOT = 0xFFFFFFFF  # slots.h
GROWTH = 1.25  # factor on the number of slots, when a view needs more
MIN_ROWS = 4096  # rows in all slots; also the rows per upload when all blocks are needed


class HostTables:
    """Tables of Gaussians in host memory, each [blocks, components, LANES]; a block has LANES rows."""

    def __init__(self, gaussians: GaussianTables) -> None:
        """gaussians: the Gaussians whose SH tables are offloaded; slots replace these tables in `gaussians.tables`."""
        self.gaussians, self.device = gaussians, gaussians.device
        self.lanes = int(self.device.tuning["LANES"])
        self.tables: dict[str, NDArray[np.float32]] = {}
        self.loaded_blocks = np.zeros(0, np.int64)  # blocks in the slots, in order
        self.slot = self._no_slots()  # slot of each block
        self._slots = 0
        self._downloads: dict[str, Callable[[], NDArray[np.float32]]] = {}  # pending, of changed slots

    def __contains__(self, name: str) -> bool:
        return name in self.tables

    @property
    def _block_count(self) -> int:
        return -(-self.gaussians.count // self.lanes)

    @property
    def block_size(self) -> int:
        """The number of `sh_rest` values in a block."""
        return int(self.tables["sh_rest"].shape[1]) * self.lanes

    def add(self, name: str, components: int) -> Array:
        """Add a table of zeros, and return its slots, [slots, components, LANES]."""
        self.finish_download()
        self._forget_slots()
        self.tables[name] = np.zeros((self._block_count, components, self.lanes), np.float32)
        return self.device.zeros((self._slots, components, self.lanes))

    def get(self, name: str) -> NDArray[np.float32]:
        """Return a table, [N, components]."""
        self.finish_download()
        table = self.tables[name]
        rows = table.transpose(0, 2, 1).reshape(self._block_count * self.lanes, table.shape[1])
        return np.ascontiguousarray(rows[: self.gaussians.count])

    def set(self, name: str, values: NDArray[np.float32]) -> None:
        """Replace the values of a table, [N, components]."""
        self.finish_download()
        self._forget_slots()
        count, width = values.shape
        rows = np.zeros((self._block_count * self.lanes, width), np.float32)
        rows[:count] = values
        self.tables[name] = np.ascontiguousarray(rows.reshape(self._block_count, self.lanes, width).transpose(0, 2, 1))

    def upload_visible(self, depth_key: Array) -> None:
        """Upload the visible blocks, and wait for the copies.  depth_key: [S], all bits set for culled Gaussians."""
        rows = self._block_count * self.lanes
        is_visible = (depth_key.get()[:rows] != NO_SLOT).reshape(-1, self.lanes).any(axis=1)
        self.load(np.flatnonzero(is_visible))

    def load(self, blocks: NDArray[np.int64]) -> None:
        """Load blocks, given in ascending order, into the slots."""
        self.finish_download()
        if np.array_equal(blocks, self.loaded_blocks):
            return
        if len(blocks) > self._slots:
            self._slots = max(int(GROWTH * len(blocks)), MIN_ROWS // self.lanes)
            for name, table in self.tables.items():
                table_slots = self.gaussians.tables[name]
                table_slots.array = self.device.empty(0)  # frees the old slots before new ones are allocated
                table_slots.array = self.device.empty((self._slots, table.shape[1], self.lanes))
        for name, table in self.tables.items():
            self._first_slots(name, len(blocks)).set(table[blocks])
        slots = np.full(self.slot.shape, NO_SLOT, np.uint32)
        slots[blocks] = np.arange(len(blocks))
        self.slot.set(slots)
        self.loaded_blocks = blocks

    def start_download(self) -> None:
        """Start downloading the slots, after the commands enqueued so far."""
        self._downloads = {name: self._first_slots(name, len(self.loaded_blocks)).get_later() for name in self.tables}

    def finish_download(self) -> None:
        """Wait for the download and write it into the tables."""
        for name, values in self._downloads.items():
            self.tables[name][self.loaded_blocks] = values()
        self._downloads = {}

    def load_parts(self) -> Iterator[None]:
        """Load all blocks into the slots in parts, and yield after each part; then load the previous blocks again."""
        previous_blocks, size = self.loaded_blocks, max(self._slots, MIN_ROWS // self.lanes)
        for first in range(0, self._block_count, size):
            self.load(np.arange(first, min(first + size, self._block_count)))
            yield
        self.load(previous_blocks)

    def set_rows(self, name: str, rows: NDArray[np.integer], values: NDArray[np.float32]) -> None:
        """Write values, [n, components], into the rows, [n], of a table."""
        table = self.get(name)
        table[rows] = values
        self.set(name, table)

    def rearrange(self, source: NDArray[np.uint32], fresh: NDArray[np.uint32]) -> dict[str, NDArray[np.float32]]:
        """Return the tables after `Gaussians.rearrange`, [rows, components]."""
        tables = {name: self.get(name)[source] for name in self.tables}
        for name, table in tables.items():
            if self.gaussians.tables[name].zero_fresh:
                table[fresh > 0] = 0
        return tables

    def _first_slots(self, name: str, count: int) -> Array:
        """Return a view of the first `count` slots of a table."""
        slots = self.gaussians.tables[name].array
        return Array(self.device, slots.buffer, (count, *slots.shape[1:]), slots.dtype)

    def _no_slots(self) -> Array:
        return self.device.upload(np.full(max(self.gaussians.capacity // self.lanes, 1), NO_SLOT, np.uint32))

    def _forget_slots(self) -> None:
        self.loaded_blocks, self.slot = np.zeros(0, np.int64), self._no_slots()


def slot_arguments(gaussians: GaussianTables) -> dict[str, Any]:
    """Return the kernel arguments that locate the SH (cl_kernels/slots.h)."""
    if gaussians.on_host:
        return {"sh_slot": gaussians.on_host.slot, "sh_block": gaussians.on_host.block_size}
    return {"sh_slot": gaussians.no_slot, "sh_block": 0}


def slot_defines(gaussians: GaussianTables) -> dict[str, int]:
    """Return the macros of kernels that read SH from slots."""
    return {"SH_SLOTS": 1} if gaussians.on_host else {}
