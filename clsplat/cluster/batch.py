"""Cells by their names, run through a store by an engine, with their results in folders of these names."""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from clsplat import terminal
from clsplat.cluster.cell import Cell
from clsplat.cluster.drive import Drive, Wanted
from clsplat.cluster.engine import Engine, Inline
from clsplat.cluster.fingerprint import Scenes
from clsplat.cluster.need import Need
from clsplat.cluster.placing import is_placed, place_copy
from clsplat.cluster.probe import places
from clsplat.cluster.progress import Watched
from clsplat.cluster.store import Store
from clsplat.cluster.task import Outcome, Terms
from clsplat.errors import ClsplatError, Interrupted
from clsplat.pipeline import matrix
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import prepare
from clsplat.runs.failures import Failures
from clsplat.runs.unprepared import check_preparation
from clsplat.signals import stop_at_once, stopping_on_signals
from clsplat.stages.training import Training

LOG = logging.getLogger("clsplat")


@dataclass
class Batch:
    """Cells that are run together, and how far they are."""

    name: str
    text: str  # what tells it from others of its name
    cells: Sequence[matrix.Cell]
    out: Path  # of the folders of results
    store: Store
    failures: Failures
    is_anew: bool = False  # whether what is in those folders is replaced
    running: dict[str, Cell] = field(default_factory=dict)
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _keys: dict[str, str] = field(default_factory=dict)
    _stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._watched = Watched({cell.name: steps_of(cell.pipeline) for cell in self.cells})

    def ready(self) -> None:
        """Called once, before the first cell begins."""

    def tell(self, stage: str | None) -> None:
        """Called when a cell has begun, which is the stage, or has ended."""

    def require_held(self) -> None:
        """Raise OutputError where its folder belongs to another process now."""

    def run(self, execution: Execution, device: str | None) -> None:
        """Run every cell, unless its result is in the store; `failures` has those that failed.

        device: the one of the engine inline.  Raises Interrupted, Different.
        """
        driving = threading.Event()
        with stopping_on_signals(lambda: ask_to_stop(self._stop, driving)), terminal.counted():
            wanted = self._wanted()
            with _engine(execution, self.store, device, self._is_stopped) as engine:
                terms = Terms(self.store.now(), execution.retries)
                drive = Drive(self.store, engine, execution.placement.bits == "same", terms, self._stop.is_set)
                driving.set()
                self._go(drive, wanted)

    def _look(self) -> None:
        """Show how far the cells are."""
        self._watched(self.store, self.running, self.outcomes)

    def _is_stopped(self) -> bool:
        """Whether a signal came; an engine in this process asks again and again."""
        self._look()
        return self._stop.is_set()

    def _wanted(self) -> list[Wanted]:
        """The cells whose scenes can be read; the others have failed."""
        scenes, found = Scenes(self.store.scenes), []
        for cell in self.cells:
            with self.failures.kept(cell.name):
                found.append(wanted_cell(cell, scenes, self.store))
        return found

    def _go(self, drive: Drive, wanted: Sequence[Wanted]) -> None:
        drive.ended, drive.look = self._ended, self._look

        def began(cell: Cell) -> None:
            if drive.is_same and not self.running and not self.outcomes:  # so that its waiting cells are seen
                for one in wanted:
                    self._keys[one.cell.name] = one.on(cell.spec["bits"]).key
                    with suppress(ClsplatError):  # told when that cell runs
                        self.store.add(one.on(cell.spec["bits"]))
            self._began(cell)

        drive.began = began
        self.ready()
        drive.run(wanted)

    def _began(self, cell: Cell) -> None:
        if self._keys.get(cell.name) != cell.key or not self.running:
            self._keys[cell.name] = cell.key
            self.store.note_sweep(self.name, self._keys, self.text)
        self.running[cell.name] = cell
        self.tell(cell.name)
        number = len(self.outcomes) + len(self.running)
        LOG.info("cell %d of %d: %s", number, len(self.cells), cell.name)

    def _ended(self, cell: Cell, outcome: Outcome) -> None:
        self.running.pop(cell.name, None)
        if outcome.state == "stopped" and self._stop.is_set():
            return
        if outcome.state == "published":
            self._place(cell)
        else:
            error = Interrupted(outcome.message) if outcome.state == "stopped" else ClsplatError(outcome.message)
            error.exit_code = outcome.exit_code
            self.failures.note(cell.name, error)
        self.outcomes[cell.name] = outcome
        self.tell(None)

    def _place(self, cell: Cell) -> None:
        """Put a result into the folder of its name, unless it is there."""
        result, here = self.store.folder(cell.key).result, self.out / cell.name
        with self.failures.kept(cell.name):
            if self.is_anew or not is_placed(result, here):
                self.require_held()
                place_copy(result, here)


def ask_to_stop(stop: threading.Event, driving: threading.Event) -> None:
    """Let the cells that run save their state and stop; before they run, and at the second signal, stop at once."""
    if stop.is_set() or not driving.is_set():
        stop_at_once()
    stop.set()


@contextmanager
def _engine(execution: Execution, store: Store, device: str | None, is_stopped: Callable[[], bool]) -> Iterator[Engine]:
    names = None if execution.devices == "auto" else execution.devices
    if execution.engine == "inline":
        chosen = [device] if device else names[:1] if names else [""]
        engine: Engine = Inline(store, places("inline", chosen)[0], is_stopped)
    else:
        from clsplat.cluster import scheduler  # where Dask is installed

        engine = scheduler.engine(execution, store, [device] if device else names)
    try:
        yield engine
    finally:
        engine.close()


def wanted_cell(cell: matrix.Cell, scenes: Scenes, store: Store) -> Wanted:
    """Return the cell of a matrix; what `prepare` makes for it is made now, before its runs.

    Raises ConfigError, DataError and the errors of the steps.
    """
    if planned := check_preparation(cell.pipeline, store.prepared.parent / cell.name):
        prepare(planned, cell.pipeline.settings.scene.folder, store.prepared)
    known = scenes.known(cell.pipeline)
    need = Need.of(cell.pipeline, known.scene) if known.scene else None
    own = Cell.of(cell.name, cell.pipeline, known.digest, bits="")
    return Wanted(own, steps_of(cell.pipeline) * known.pixels, need)


def steps_of(pipeline: Pipeline) -> int:
    """Return the steps of all trainings of a pipeline."""
    return sum(stage.steps for stage in pipeline.stages if isinstance(stage, Training))
