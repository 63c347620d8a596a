"""Assign the cells of a sweep to the devices of an engine: the longest cells first, and one cell per device."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from clsplat.core.errors import DeviceError, Interrupted, MemoryLimitError
from clsplat.sweeps.cell import CellRun
from clsplat.sweeps.child import plugin_files, run_command
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.store import BitsMismatch, Store
from clsplat.sweeps.task import CellOptions, Outcome, run_cell


class Ticket(Protocol):
    """A cell that is running on an engine."""

    def outcome(self) -> Outcome | None:
        """Return the outcome of the cell, or None while it runs.  Raises CellLost if its process no longer exists."""


class CellLost(Exception):
    """The process of a cell no longer exists; the cell continues from its checkpoint in another process."""


class Engine(Protocol):
    """A provider of devices that runs cells on them."""

    def slots(self) -> list[DeviceSlot]:
        """Return the devices that are available now.  Raises ClsplatError if none can become available."""

    def start(self, cell: CellRun, slot: DeviceSlot, options: CellOptions) -> Ticket:
        """Start a cell on a free device."""

    def close(self) -> None:
        """Stop all running cells, and release the devices."""


class _FinishedTicket:
    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome

    def outcome(self) -> Outcome:
        return self._outcome


class InlineEngine:
    """An engine that runs one cell at a time, in a child process."""

    def __init__(self, store: Store, slot: DeviceSlot, is_stopped: Callable[[], bool]) -> None:
        self._store, self._slot, self._is_stopped = store, slot, is_stopped

    def slots(self) -> list[DeviceSlot]:
        return [self._slot]

    def start(self, cell: CellRun, slot: DeviceSlot, options: CellOptions) -> Ticket:
        command = run_command(slot.device, plugin_files())
        return _FinishedTicket(run_cell(cell, self._store, command, options, self._is_stopped))

    def close(self) -> None:
        pass


LOG = logging.getLogger("clsplat")
POLL_INTERVAL_S = 0.05  # time between two checks of running cells
NO_DEVICE_TIMEOUT_S = 60.0  # a sweep fails after this time without a suitable device


@dataclass(frozen=True)
class PendingCell:
    """A cell that waits for a device."""

    cell: CellRun  # without a bits class
    cost: float  # steps times pixels; determines the order of cells
    failed_memory: int = 0  # memory of the largest device on which the cell ran out of memory, bytes

    def in_class(self, bits: str) -> CellRun:
        """Return a copy of the cell for devices of a bits class."""
        return replace(self.cell, spec={**self.cell.spec, "bits": bits})


@dataclass
class Dispatcher:
    """A loop that assigns cells to devices until all cells have finished."""

    store: Store
    engine: Engine
    is_same: bool  # whether all cells run in one bits class
    options: CellOptions
    is_stopped: Callable[[], bool] = lambda: False
    on_start: Callable[[CellRun], None] = lambda cell: None
    on_end: Callable[[CellRun, Outcome], None] = lambda cell, outcome: None
    poll: Callable[[], None] = lambda: None  # called regularly
    bits: str | None = None  # chosen bits class of all cells; None: not chosen yet, or `is_same` is False
    _last_available: float = field(default_factory=time.monotonic)  # when a device of that class was last available
    _unsuitable: tuple[list[DeviceSlot], set[DeviceSlot]] = field(default_factory=lambda: ([], set()))
    """The devices of the last assignment, and those of them on which no pending cell can run."""
    _running: dict[DeviceSlot, tuple[PendingCell, CellRun, Ticket]] = field(default_factory=dict)

    def run(self, cells: Sequence[PendingCell]) -> None:
        """Run all cells, and call `on_end` for each.

        Raises BitsMismatch if two runs of a cell differ, Interrupted, and the errors of the engine.  After an error,
        the caller has to close the engine, which stops the running cells.
        """
        pending_cells = sorted(cells, key=lambda pending: -pending.cost)
        while pending_cells or self._running:
            if self.is_stopped():
                raise Interrupted("stopped; continue with the same command and --resume")
            self._assign(pending_cells)
            count = len(self._running)
            for slot in list(self._running):
                self._collect(slot, pending_cells)
            self.poll()
            if (self._running and len(self._running) == count) or (pending_cells and not self._running):
                time.sleep(POLL_INTERVAL_S)

    def _assign(self, pending_cells: list[PendingCell]) -> None:
        slots = sorted(self.engine.slots(), key=lambda slot: -slot.memory)  # the longest cell gets the largest device
        classes = [slot.bits for slot in slots]
        if self.is_same and self.bits is None and classes:
            self.bits = self._choose_class(classes, pending_cells)
        self._require_class(classes)
        if self._unsuitable[0] != slots:
            self._unsuitable = (slots, set())
        for slot in slots:
            if slot in self._running or slot in self._unsuitable[1]:
                continue
            index = next((i for i, pending in enumerate(pending_cells) if self._fits(pending, slot, slots)), None)
            if index is None:
                self._unsuitable[1].add(slot)  # because each check reads the store
                continue
            pending = pending_cells.pop(index)
            cell = pending.in_class(slot.bits)
            self.on_start(cell)
            self._running[slot] = (pending, cell, self.engine.start(cell, slot, self.options))

    def _choose_class(self, classes: Sequence[str], cells: Sequence[PendingCell]) -> str:
        """Return the class with the most devices.  Break ties by the number of published cells, then by name."""
        counts = Counter(classes)
        candidates = sorted(bits for bits in counts if counts[bits] == max(counts.values()))
        return max(
            candidates,
            key=lambda bits: sum(self.store.folder(pending.in_class(bits).key).result.is_dir() for pending in cells),
        )

    def _require_class(self, classes: Sequence[str]) -> None:
        """Raise DeviceError if only devices of other classes have been available for NO_DEVICE_TIMEOUT_S seconds."""
        now = time.monotonic()
        if not self.is_same or not classes or self.bits in classes or self._running:
            self._last_available = now
        elif now - self._last_available > NO_DEVICE_TIMEOUT_S:
            available = ", ".join(sorted({*classes}))
            raise DeviceError(
                f"no device of bits class {self.bits} for {NO_DEVICE_TIMEOUT_S:.0f} s, only of {available}; offer a "
                "device of that class, or set placement: {bits: any}; the store keeps all progress"
            )

    def _fits(self, pending: PendingCell, slot: DeviceSlot, slots: Sequence[DeviceSlot]) -> bool:
        """Return whether a cell may run on a device.

        The device must be in the cell's bits class.  If possible, it has more memory than devices on which the cell
        ran out of memory.
        """
        allowed_slots = self._allowed_slots(pending, slots)
        return slot in ([item for item in allowed_slots if item.memory > pending.failed_memory] or allowed_slots)

    def _allowed_slots(self, pending: PendingCell, slots: Sequence[DeviceSlot]) -> list[DeviceSlot]:
        """Return the devices on which a cell may run.  A started cell stays in its class if possible."""
        if self.is_same:
            return [slot for slot in slots if slot.bits == self.bits]
        classes = {slot.bits for slot in slots if not pending.failed_memory}
        started_classes = [bits for bits in classes if self.store.folder(pending.in_class(bits).key).path.is_dir()]
        return [slot for slot in slots if not started_classes or slot.bits in started_classes]

    def _collect(self, slot: DeviceSlot, pending_cells: list[PendingCell]) -> None:
        pending, cell, ticket = self._running[slot]
        try:
            outcome = ticket.outcome()
        except CellLost:
            self.store.log_event("lost", cell=cell.key, worker=slot.worker)
            self._requeue(pending, slot, pending_cells)
            return
        if outcome is None:
            return
        if outcome.state == "different":
            raise BitsMismatch(outcome.message)
        retry = replace(pending, failed_memory=slot.memory)
        if outcome.exit_code == MemoryLimitError.exit_code and any(
            candidate.memory > slot.memory for candidate in self._allowed_slots(retry, self.engine.slots())
        ):
            LOG.warning("cell %s: %s; trying a larger device", cell.name, outcome.message)
            self._requeue(retry, slot, pending_cells)
            return
        del self._running[slot]
        self.on_end(cell, outcome)

    def _requeue(self, pending: PendingCell, slot: DeviceSlot, pending_cells: list[PendingCell]) -> None:
        """Put a cell back at the front of the queue, and free its device."""
        del self._running[slot]
        pending_cells.insert(0, pending)
        self._unsuitable[1].clear()
