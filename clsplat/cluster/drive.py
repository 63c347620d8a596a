"""Hand the cells of a sweep to the devices of an engine: the longest first, one a device, those of one bits class."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from clsplat.cluster.cell import Cell
from clsplat.cluster.engine import Engine, Lost, Ticket
from clsplat.cluster.folder import Different
from clsplat.cluster.probe import Place
from clsplat.cluster.store import Store
from clsplat.cluster.task import Outcome, Terms
from clsplat.errors import Interrupted

LOOK = 0.05  # seconds between two looks at what runs


@dataclass(frozen=True)
class Wanted:
    """A cell before a device is chosen."""

    cell: Cell  # of no class
    cost: float  # steps times pixels, to compare

    def on(self, bits: str) -> Cell:
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
    began: Callable[[Cell], None] = lambda cell: None
    ended: Callable[[Cell, Outcome], None] = lambda cell, outcome: None
    look: Callable[[], None] = lambda: None  # called again and again
    bits: str | None = None  # the class of all cells, once it is chosen
    _running: dict[Place, tuple[Wanted, Cell, Ticket]] = field(default_factory=dict)

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
        places = self.engine.places()
        classes = [place.bits for place in places]
        if self.is_same and self.bits is None and classes:
            self.bits = Counter(classes).most_common(1)[0][0]
        for place in places:
            suited = [i for i, one in enumerate(waiting) if self._suits(one, place.bits, classes)]
            if place in self._running or not suited:
                continue
            one = waiting.pop(suited[0])
            cell = one.on(place.bits)
            self.began(cell)
            self._running[place] = (one, cell, self.engine.start(cell, place, self.terms))

    def _suits(self, one: Wanted, bits: str, classes: Sequence[str]) -> bool:
        """Whether a cell may run in a class: one that has begun stays in its own, where that has devices now."""
        if self.is_same:
            return bits == self.bits
        begun = [own for own in set(classes) if self.store.folder(one.on(own).key).path.is_dir()]
        return not begun or bits in begun

    def _take_in(self, place: Place, waiting: list[Wanted]) -> None:
        one, cell, ticket = self._running[place]
        try:
            outcome = ticket.outcome()
        except Lost:
            del self._running[place]
            self.store.tell("lost", cell=cell.key, worker=place.worker)
            waiting.insert(0, one)
            return
        if outcome is not None and outcome.state == "different":
            raise Different(outcome.message)
        if outcome is not None:
            del self._running[place]
            self.ended(cell, outcome)
