"""Run the cells of a matrix through a store, and put their results into the folder of the matrix."""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from clsplat import terminal
from clsplat.cluster.attempt import is_placed, place_copy
from clsplat.cluster.cell import Cell
from clsplat.cluster.drive import Drive, Wanted
from clsplat.cluster.engine import Engine, Inline
from clsplat.cluster.execution import Execution
from clsplat.cluster.fingerprint import Scenes
from clsplat.cluster.probe import places
from clsplat.cluster.progress import Watched
from clsplat.cluster.store import Store
from clsplat.cluster.task import Outcome, Terms
from clsplat.errors import ClsplatError, Interrupted, one_line
from clsplat.files import write_text
from clsplat.names import PIPELINE
from clsplat.pipeline import matrix
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.matrix import Experiment
from clsplat.prepare.cache import plan, prepare
from clsplat.runs import folders
from clsplat.runs.experiment import check_matrix_folder, compare, first_of
from clsplat.runs.failures import failures_recorded
from clsplat.runs.folders import Start
from clsplat.signals import stop_at_once, stopping_on_signals
from clsplat.stages.training import Training
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")


def run_sweep(
    experiment: Experiment,
    out: Path,
    execution: Execution,
    device: str | None,
    start: Start,
) -> None:
    """Run every cell, unless its result is in the store, and write compare.html; `out` is as after a run without store.

    device: the one of the engine inline.  A cell that fails does not stop the others; at the end a ClsplatError is
    raised with the exit code of the first one.  Raises Interrupted, Different.
    """
    check_matrix_folder(out)
    store = Store(execution.keeps or Path())
    stop, driving = threading.Event(), threading.Event()
    with (
        folders.opened(out, start, cells=len(experiment.cells), done=0, failed={}) as status,
        failures_recorded(status),
        stopping_on_signals(lambda: ask_to_stop(stop, driving)),
        terminal.counted(),
    ):
        write_text(out / PIPELINE, experiment.text)
        sweep = _Sweep(experiment, status, store, stop)
        wanted = sweep.wanted()
        with _engine(execution, store, device, sweep.is_stopped) as engine:
            terms = Terms(store.now(), execution.retries)
            drive = Drive(store, engine, execution.placement.bits == "same", terms, stop.is_set)
            driving.set()
            sweep.go(drive, wanted)
        status.require_held()
        compare(experiment, out, sweep.failures)
        if sweep.failures:
            raise first_of(sweep.failures, len(experiment.cells), "failed")
        status.end("done", exit_code=0)


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
    settings = cell.pipeline.settings
    if settings.prepare:
        folder = settings.scene.folder
        prepare(plan(settings.prepare, folder, store.prepared), folder, store.prepared)
    known = scenes.known(cell.pipeline)
    return Wanted(Cell.of(cell.name, cell.pipeline, known.digest, bits=""), steps_of(cell.pipeline) * known.pixels)


def steps_of(pipeline: Pipeline) -> int:
    """Return the steps of all trainings of a pipeline."""
    return sum(stage.steps for stage in pipeline.stages if isinstance(stage, Training))


@dataclass
class _Sweep:
    """What the driver keeps of a sweep."""

    experiment: Experiment
    status: StatusFile
    store: Store
    stop: threading.Event
    failures: dict[str, ClsplatError] = field(default_factory=dict)
    running: dict[str, Cell] = field(default_factory=dict)
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._watched = Watched({cell.name: steps_of(cell.pipeline) for cell in self.experiment.cells})

    def look(self) -> None:
        """Show how far the cells are."""
        self._watched(self.store, self.running, self.outcomes)

    def is_stopped(self) -> bool:
        """Whether a signal came; an engine in this process asks again and again."""
        self.look()
        return self.stop.is_set()

    def wanted(self) -> list[Wanted]:
        """Return the cells whose scenes can be read; the others have failed."""
        scenes, found = Scenes(self.store.scenes), []
        for cell in self.experiment.cells:
            try:
                found.append(wanted_cell(cell, scenes, self.store))
            except Interrupted:
                raise
            except ClsplatError as error:
                self._failed(cell.name, error)
        return found

    def go(self, drive: Drive, wanted: Sequence[Wanted]) -> None:
        drive.ended, drive.look = self._ended, self.look

        def began(cell: Cell) -> None:
            if drive.is_same and not self.running and not self.outcomes:  # so that its waiting cells are seen
                for one in wanted:
                    self.keys[one.cell.name] = self.store.add(one.on(cell.spec["bits"])).key
            self._began(cell)

        drive.began = began
        self.status.enter("running")
        drive.run(wanted)

    def _began(self, cell: Cell) -> None:
        if self.keys.get(cell.name) != cell.key or not self.running:
            self.keys[cell.name] = cell.key
            self.store.note_sweep(self.experiment.name, self.keys)
        self.running[cell.name] = cell
        self.status.note(stage=cell.name)
        number = len(self.outcomes) + len(self.running)
        LOG.info("cell %d of %d: %s", number, len(self.experiment.cells), cell.name)

    def _ended(self, cell: Cell, outcome: Outcome) -> None:
        self.running.pop(cell.name, None)
        if outcome.state == "stopped" and self.stop.is_set():
            return
        if outcome.state == "published":
            self._place(cell)
        else:
            error = Interrupted(outcome.message) if outcome.state == "stopped" else ClsplatError(outcome.message)
            error.exit_code = outcome.exit_code
            self._failed(cell.name, error)
        self.outcomes[cell.name] = outcome
        self.status.note(
            done=len({*self.outcomes, *self.failures}),
            failed={name: one_line(one) for name, one in self.failures.items()},
        )
        self.status.refresh()

    def _place(self, cell: Cell) -> None:
        """Put a result into the folder of the matrix, unless it is there."""
        result, here = self.store.folder(cell.key).result, self.status.out / cell.name
        try:
            if is_placed(result, here):
                return
            self.status.require_held()
            place_copy(result, here)
        except ClsplatError as error:
            self._failed(cell.name, error)

    def _failed(self, name: str, error: ClsplatError) -> None:
        self.failures[name] = error
        LOG.warning("cell %s failed: %s", name, one_line(error))
