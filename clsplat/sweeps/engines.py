"""Hand the cells of a sweep to the devices of an engine: the longest first, one a device, those of one bits class."""

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
from clsplat.sweeps.store import Different, Store
from clsplat.sweeps.task import Outcome, Terms, run_cell

# What an engine is for a sweep, and the one that runs cells in this process.


class Ticket(Protocol):
    """A cell that was handed to an engine."""

    def outcome(self) -> Outcome | None:
        """Return how it ended; None while it runs.  Raises CellLost where nobody runs it any more, and its errors."""


class CellLost(Exception):
    """The process that ran a cell is gone; the cell goes on from its checkpoint elsewhere."""


class Engine(Protocol):
    """Devices, and a way to run a cell on one of them."""

    def places(self) -> list[DeviceSlot]:
        """Return the devices that are there now.  Raises ClsplatError where there will be none."""

    def start(self, cell: CellRun, place: DeviceSlot, terms: Terms) -> Ticket:
        """Begin to run a cell on a device that is free."""

    def close(self) -> None:
        """End what was started."""


class _Ended:
    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome

    def outcome(self) -> Outcome:
        return self._outcome


class InlineEngine:
    """Runs a cell at a time, each as a child of this process."""

    def __init__(self, store: Store, place: DeviceSlot, is_stopped: Callable[[], bool]) -> None:
        self._store, self._place, self._is_stopped = store, place, is_stopped

    def places(self) -> list[DeviceSlot]:
        return [self._place]

    def start(self, cell: CellRun, place: DeviceSlot, terms: Terms) -> Ticket:
        command = run_command(place.device, plugin_files())
        return _Ended(run_cell(cell, self._store, command, terms, self._is_stopped))

    def close(self) -> None:
        pass


LOG = logging.getLogger("clsplat")
LOOK = 0.05  # seconds between two looks at what runs
ALONE = 60.0  # seconds without a device that may run a cell, after which a sweep ends


@dataclass(frozen=True)
class Wanted:
    """A cell before a device is chosen."""

    cell: CellRun  # of no class
    cost: float  # steps times pixels, to compare
    above: int = 0  # bytes of the largest device that did not hold it

    def on(self, bits: str) -> CellRun:
        """Return the cell in a bits class."""
        return replace(self.cell, spec={**self.cell.spec, "bits": bits})


@dataclass
class Drive:
    """A sweep in progress."""

    store: Store
    engine: Engine
    is_same: bool  # all cells in one bits class
    terms: Terms
    is_stopped: Callable[[], bool] = lambda: False
    began: Callable[[CellRun], None] = lambda cell: None
    ended: Callable[[CellRun, Outcome], None] = lambda cell, outcome: None
    look: Callable[[], None] = lambda: None  # called again and again
    bits: str | None = None  # the class of all cells, once it is chosen
    _seen: float = field(default_factory=time.monotonic)  # when a device of that class was there last
    _unsuited: tuple[list[DeviceSlot], set[DeviceSlot]] = field(default_factory=lambda: ([], set()))
    """All devices, and those that suit no cell that waits."""
    _running: dict[DeviceSlot, tuple[Wanted, CellRun, Ticket]] = field(default_factory=dict)

    def run(self, wanted: Sequence[Wanted]) -> None:
        """Run all cells, and tell `ended` how each did.

        Raises Different where two runs of a cell have other bits, Interrupted, and what the engine raises; then the
        cells that run are left to `close` of the engine.
        """
        waiting = sorted(wanted, key=lambda one: -one.cost)
        while waiting or self._running:
            if self.is_stopped():
                raise Interrupted("stopped; the same command with --resume goes on")
            self._hand_out(waiting)
            before = len(self._running)
            for place in list(self._running):
                self._take_in(place, waiting)
            self.look()
            if (self._running and len(self._running) == before) or (waiting and not self._running):
                time.sleep(LOOK)

    def _hand_out(self, waiting: list[Wanted]) -> None:
        places = sorted(self.engine.places(), key=lambda place: -place.memory)  # for the longest cell the largest
        classes = [place.bits for place in places]
        if self.is_same and self.bits is None and classes:
            self.bits = self._chosen(classes, waiting)
        self._require_class(classes)
        if self._unsuited[0] != places:
            self._unsuited = (places, set())
        for place in places:
            if place in self._running or place in self._unsuited[1]:
                continue
            suited = next((i for i, one in enumerate(waiting) if self._suits(one, place, places)), None)
            if suited is None:
                self._unsuited[1].add(place)  # looking again and again would read the store each time
                continue
            one = waiting.pop(suited)
            cell = one.on(place.bits)
            self.began(cell)
            self._running[place] = (one, cell, self.engine.start(cell, place, self.terms))

    def _chosen(self, classes: Sequence[str], wanted: Sequence[Wanted]) -> str:
        """Return the class of most devices; of several that in which most cells are published, then by name."""
        counts = Counter(classes)
        most = sorted(own for own in counts if counts[own] == max(counts.values()))
        return max(most, key=lambda own: sum(self.store.folder(one.on(own).key).result.is_dir() for one in wanted))

    def _require_class(self, classes: Sequence[str]) -> None:
        """Raise DeviceError where devices are there, but for `ALONE` seconds none of the chosen class."""
        now = time.monotonic()
        if not self.is_same or not classes or self.bits in classes or self._running:
            self._seen = now
        elif now - self._seen > ALONE:
            others = ", ".join(sorted({*classes}))
            raise DeviceError(
                f"no device of bits class {self.bits} for {ALONE:.0f} s; there are devices of {others}; "
                "offer one of that class, or set placement: {bits: any}; what was done is in the store"
            )

    def _suits(self, one: Wanted, place: DeviceSlot, places: Sequence[DeviceSlot]) -> bool:
        """Whether a cell may run on a device: of its class, and larger than those that did not hold it, if one is."""
        allowed = self._allowed(one, places)
        return place in ([other for other in allowed if other.memory > one.above] or allowed)

    def _allowed(self, one: Wanted, places: Sequence[DeviceSlot]) -> list[DeviceSlot]:
        """The devices in whose class a cell may run: one that has begun stays in its own, where that is there now."""
        if self.is_same:
            return [place for place in places if place.bits == self.bits]
        own = {place.bits for place in places if not one.above}
        begun = [bits for bits in own if self.store.folder(one.on(bits).key).path.is_dir()]
        return [place for place in places if not begun or place.bits in begun]

    def _take_in(self, place: DeviceSlot, waiting: list[Wanted]) -> None:
        one, cell, ticket = self._running[place]
        try:
            outcome = ticket.outcome()
        except CellLost:
            self.store.tell("lost", cell=cell.key, worker=place.worker)
            self._again(one, place, waiting)
            return
        if outcome is None:
            return
        if outcome.state == "different":
            raise Different(outcome.message)
        larger = replace(one, above=place.memory)
        if outcome.exit_code == MemoryLimitError.exit_code and any(
            other.memory > place.memory for other in self._allowed(larger, self.engine.places())
        ):
            LOG.warning("cell %s: %s; it goes to a larger device", cell.name, outcome.message)
            self._again(larger, place, waiting)
            return
        del self._running[place]
        self.ended(cell, outcome)

    def _again(self, one: Wanted, place: DeviceSlot, waiting: list[Wanted]) -> None:
        """Let a cell wait, and others take its device."""
        del self._running[place]
        waiting.insert(0, one)
        self._unsuited[1].clear()
