"""What an engine is for a sweep, and the one that runs cells in this process."""

from collections.abc import Callable
from typing import Protocol

from clsplat.cluster.cell import Cell
from clsplat.cluster.child import run_command
from clsplat.cluster.plugin_files import plugin_files
from clsplat.cluster.probe import Place
from clsplat.cluster.store import Store
from clsplat.cluster.task import Outcome, Terms, run_cell


class Ticket(Protocol):
    """A cell that was handed to an engine."""

    def outcome(self) -> Outcome | None:
        """Return how it ended; None while it runs.  Raises Lost where nobody runs it any more, and its errors."""


class Lost(Exception):
    """The process that ran a cell is gone; the cell goes on from its checkpoint elsewhere."""


class Engine(Protocol):
    """Devices, and a way to run a cell on one of them."""

    def places(self) -> list[Place]:
        """Return the devices that are there now.  Raises ClsplatError where there will be none."""

    def may_join(self, waited: float) -> bool:
        """Whether other devices may still join a sweep that has waited for them, for so many seconds."""

    def start(self, cell: Cell, place: Place, terms: Terms) -> Ticket:
        """Begin to run a cell on a device that is free."""

    def close(self) -> None:
        """End what was started."""


class _Ended:
    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome

    def outcome(self) -> Outcome:
        return self._outcome


class Inline:
    """Runs a cell at a time, each as a child of this process."""

    def __init__(self, store: Store, place: Place, is_stopped: Callable[[], bool]) -> None:
        self._store, self._place, self._is_stopped = store, place, is_stopped

    def places(self) -> list[Place]:
        return [self._place]

    def may_join(self, waited: float) -> bool:
        return False

    def start(self, cell: Cell, place: Place, terms: Terms) -> Ticket:
        command = run_command(place.device, plugin_files())
        return _Ended(run_cell(cell, self._store, command, terms, self._is_stopped))

    def close(self) -> None:
        pass
