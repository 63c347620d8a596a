"""The harmonics above band 0, with their moments, in the memory of the host.

They are 540 of the 708 bytes of a Gaussian of degree 3 with its moments.  On the device are the blocks of LANES rows
that a view sees, in slots (cl_kernels/slots.h), in the order of their rows: sent before the view is drawn, and fetched
when another comes.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.structs import Struct
from clsplat.opencl.device import Array

NO_SLOT = 0xFFFFFFFF  # slots.h
GROWTH = 1.25  # of the slots, where a view sees more
FEWEST = 4096  # rows in the slots, as many as are sent at a time where all rows are needed


class HostTables:
    """Tables of a Gaussians struct that lie on the host, [blocks, components, LANES] each; blocks: of LANES rows."""

    def __init__(self, gaussians: Struct) -> None:
        """gaussians: they change `tables`, where each of these is its slots."""
        self.gaussians, self.device = gaussians, gaussians.device
        self.lanes = int(self.device.tuning["LANES"])
        self.tables: dict[str, NDArray[np.float32]] = {}
        self.held = np.zeros(0, np.int64)  # blocks that have slots, in their order
        self.slot = self._no_slots()  # of each block
        self._slots = 0
        self._fetched: dict[str, Callable[[], NDArray[np.float32]]] = {}  # of slots that the device has changed

    def __contains__(self, name: str) -> bool:
        return name in self.tables

    @property
    def _blocks(self) -> int:
        return -(-self.gaussians.count // self.lanes)

    @property
    def block(self) -> int:
        """Values of a block of the harmonics in its slot."""
        return int(self.tables["sh_rest"].shape[1]) * self.lanes

    def add(self, name: str, components: int) -> Array:
        """Attach a table of zeros; return its slots."""
        self.put_back()
        self._forget_slots()
        self.tables[name] = np.zeros((self._blocks, components, self.lanes), np.float32)
        return self.device.zeros((self._slots, components, self.lanes))

    def get(self, name: str) -> NDArray[np.float32]:
        """Return a table, [N, components]."""
        self.put_back()
        table = self.tables[name]
        rows = table.transpose(0, 2, 1).reshape(self._blocks * self.lanes, table.shape[1])
        return np.ascontiguousarray(rows[: self.gaussians.count])

    def set(self, name: str, values: NDArray[np.float32]) -> None:
        """Replace a table by [N, components]."""
        self.put_back()
        self._forget_slots()
        count, components = values.shape
        rows = np.zeros((self._blocks * self.lanes, components), np.float32)
        rows[:count] = values
        self.tables[name] = np.ascontiguousarray(rows.reshape(self._blocks, self.lanes, components).transpose(0, 2, 1))

    def bring(self, depth_key: Array) -> None:
        """Send the blocks of rows that a view sees.  depth_key: [S], all ones where it culls.  Waits for the device."""
        rows = self._blocks * self.lanes
        seen = (depth_key.get()[:rows] != NO_SLOT).reshape(-1, self.lanes).any(axis=1)
        self.load(np.flatnonzero(seen))

    def load(self, blocks: NDArray[np.int64]) -> None:
        """Put these blocks, in growing order, into the slots."""
        self.put_back()
        if np.array_equal(blocks, self.held):
            return
        if len(blocks) > self._slots:
            self._slots = max(int(GROWTH * len(blocks)), FEWEST // self.lanes)
            for name, table in self.tables.items():
                held = self.gaussians.tables[name]
                held.array = self.device.empty(0)  # released before its successor is allocated
                held.array = self.device.empty((self._slots, table.shape[1], self.lanes))
        for name, table in self.tables.items():
            self._part(name, len(blocks)).set(table[blocks])
        slots = np.full(self.slot.shape, NO_SLOT, np.uint32)
        slots[blocks] = np.arange(len(blocks))
        self.slot.set(slots)
        self.held = blocks

    def begin_to_fetch(self) -> None:
        """Fetch the slots, which the device has changed, after all that is enqueued so far."""
        self._fetched = {name: self._part(name, len(self.held)).get_later() for name in self.tables}

    def put_back(self) -> None:
        """Write what was fetched into the tables; waits for it."""
        for name, values in self._fetched.items():
            self.tables[name][self.held] = values()
        self._fetched = {}

    def parts(self) -> Iterator[None]:
        """Have all blocks in the slots, some at a time; then those that were there."""
        before, some = self.held, max(self._slots, FEWEST // self.lanes)
        for first in range(0, self._blocks, some):
            self.load(np.arange(first, min(first + some, self._blocks)))
            yield
        self.load(before)

    def set_rows(self, name: str, rows: NDArray[np.integer], values: NDArray[np.float32]) -> None:
        """Write [n, components] into some rows, [n], of a table."""
        table = self.get(name)
        table[rows] = values
        self.set(name, table)

    def rearranged(self, source: NDArray[np.uint32], fresh: NDArray[np.uint32]) -> dict[str, NDArray[np.float32]]:
        """Return the tables as `Gaussians.rearrange` makes them, [rows, components]."""
        tables = {name: self.get(name)[source] for name in self.tables}
        for name, table in tables.items():
            if self.gaussians.tables[name].zero_fresh:
                table[fresh > 0] = 0
        return tables

    def _part(self, name: str, count: int) -> Array:
        """The first slots of a table."""
        slots = self.gaussians.tables[name].array
        return Array(self.device, slots.buffer, (count, *slots.shape[1:]), slots.dtype)

    def _no_slots(self) -> Array:
        return self.device.upload(np.full(max(self.gaussians.capacity // self.lanes, 1), NO_SLOT, np.uint32))

    def _forget_slots(self) -> None:
        self.held, self.slot = np.zeros(0, np.int64), self._no_slots()


def slot_arguments(gaussians: Struct) -> dict[str, Any]:
    """Return the arguments of kernels that say where the harmonics lie (cl_kernels/slots.h)."""
    if gaussians.on_host:
        return {"sh_slot": gaussians.on_host.slot, "sh_block": gaussians.on_host.block}
    return {"sh_slot": gaussians.no_slot, "sh_block": 0}


def slot_defines(gaussians: Struct) -> dict[str, int]:
    """Return what chooses the programs that find the harmonics there."""
    return {"SH_SLOTS": 1} if gaussians.on_host else {}
