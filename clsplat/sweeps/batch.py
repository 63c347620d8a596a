"""Cells by their names, run through a store by an engine, with their results in folders of these names."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, Interrupted
from clsplat.core.files import PIPELINE, raising_output_error
from clsplat.core.progress import Count
from clsplat.core.reading import read_json
from clsplat.core.signals import stop_at_once, stopping_on_signals
from clsplat.pipeline import matrix
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Cell as MatrixCell
from clsplat.pipeline.matrix import Experiment, load_experiment
from clsplat.prepare.cache import prepare
from clsplat.runs.failures import Failures
from clsplat.runs.opening import check_preparation
from clsplat.runs.run_folder import Start
from clsplat.runs.state import Phase, RunState, read_sums, sum_of
from clsplat.sweeps.cell import CellRun, Scenes
from clsplat.sweeps.child import plugin_files, run_command
from clsplat.sweeps.devices import places
from clsplat.sweeps.engines import Drive, Engine, InlineEngine, Wanted
from clsplat.sweeps.experiment import matrix_opened
from clsplat.sweeps.store import ERRORS, LEASE, MANIFEST, Store, copy_files, link_or_copy
from clsplat.sweeps.task import Outcome, Terms, run_cell
from clsplat.training import checkpoint
from clsplat.training.stage import Training
from clsplat.training.status import StatusFile, read_status

# The result of a cell in the folder of its matrix.


def place_copy(source: Path, target: Path) -> None:
    """Let a folder hold the files of a result, linked where nothing changes them in place; the manifest comes last.

    Raises OutputError.
    """
    with raising_output_error(target):
        for old in (target / MANIFEST, *checkpoint.saved(target)):  # later checkpoints are of another run
            old.unlink(missing_ok=True)
        copy_files(source, target, {LEASE, ERRORS, MANIFEST})
        link_or_copy(source / MANIFEST, target / MANIFEST)


def is_placed(source: Path, target: Path) -> bool:
    """Whether a folder holds the files of a result, as `place_copy` leaves them.

    Raises ConfigError where a run has gone on in it, with settings of its own.
    """
    placed = None
    with suppress(DataError, KeyError, TypeError):
        placed = read_json(target / MANIFEST)["files"][PIPELINE]
    if placed and sum_of(target / PIPELINE) not in (None, placed):
        raise ConfigError(
            f"{target}: was trained on with other settings since the sweep had put its result there; move that folder, "
            "and run the sweep again with --resume"
        )
    here = RunState.read(target)
    return here.phase is Phase.DONE and here.sums == read_sums(source) and not here.lost


# How far the cells of a sweep are: a line of the log now and then, a bar in the terminal.

EVERY = 2.0  # seconds between two looks at the files
SHOWN = 4  # cells that are named


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
    running: dict[str, CellRun] = field(default_factory=dict)
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _keys: dict[str, str] = field(default_factory=dict)
    _stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._steps = {cell.name: steps_of(cell.pipeline) for cell in self.cells}
        self._count, self._looked = Count("steps", sum(self._steps.values())), time.monotonic()

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
        with stopping_on_signals(lambda: ask_to_stop(self._stop, driving)), terminal.counts_on_terminal():
            wanted = self._wanted()
            with _engine(execution, self.store, device, self._is_stopped) as engine:
                terms = Terms(self.store.now(), execution.retries)
                drive = Drive(self.store, engine, execution.placement.bits == "same", terms, self._stop.is_set)
                driving.set()
                self._go(drive, wanted)

    def _look(self) -> None:
        """Show how far the cells are, from the files of those that run, where it is time to."""
        if time.monotonic() - self._looked < EVERY:
            return
        self._looked = time.monotonic()
        done, told = sum(self._steps[name] for name in self.outcomes), []
        for name, cell in self.running.items():
            newest = max(self.store.folder(cell.key).attempts(), key=lambda attempt: attempt.beaten, default=None)
            step = read_status(newest.path).get("step") if newest else 0
            if isinstance(step, int):
                done += step
                told.append(f"{name} {step}/{self._steps[name]}")
        named = ", ".join([*told[:SHOWN], *(["…"] if len(told) > SHOWN else [])])
        self._count.what = f"steps ({named})" if told else "steps"
        self._count.reach(min(done, self._count.total))

    def _is_stopped(self) -> bool:
        """Whether a signal came; an engine in this process asks again and again."""
        self._look()
        return self._stop.is_set()

    def _wanted(self) -> list[Wanted]:
        """The cells whose scenes can be read; the others have failed."""
        scenes, found = Scenes(self.store.prepared), []
        for cell in self.cells:
            with self.failures.kept(cell.name):
                found.append(wanted_cell(cell, scenes, self.store))
        return found

    def _go(self, drive: Drive, wanted: Sequence[Wanted]) -> None:
        drive.ended, drive.look = self._ended, self._look

        def began(cell: CellRun) -> None:
            if drive.is_same and not self.running and not self.outcomes:  # so that its waiting cells are seen
                for one in wanted:
                    self._keys[one.cell.name] = one.on(cell.spec["bits"]).key
                    with suppress(ClsplatError):  # told when that cell runs
                        self.store.add(one.on(cell.spec["bits"]))
            self._began(cell)

        drive.began = began
        self.ready()
        drive.run(wanted)

    def _began(self, cell: CellRun) -> None:
        if self._keys.get(cell.name) != cell.key or not self.running:
            self._keys[cell.name] = cell.key
            self.store.note_sweep(self.name, self._keys, self.text)
        self.running[cell.name] = cell
        self.tell(cell.name)
        number = len(self.outcomes) + len(self.running)
        LOG.info("cell %d of %d: %s", number, len(self.cells), cell.name)

    def _ended(self, cell: CellRun, outcome: Outcome) -> None:
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

    def _place(self, cell: CellRun) -> None:
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
        engine: Engine = InlineEngine(store, places("inline", chosen)[0], is_stopped)
    else:
        from clsplat.sweeps import dask  # where Dask is installed

        engine = dask.engine(execution, store, [device] if device else names)
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
    own = CellRun.of(cell.name, cell.pipeline, known.digest, bits="")
    return Wanted(own, steps_of(cell.pipeline) * known.pixels)


def steps_of(pipeline: Pipeline) -> int:
    """Return the steps of all trainings of a pipeline."""
    return sum(stage.steps for stage in pipeline.stages if isinstance(stage, Training))


# One cell by itself: what `sbatch --array` calls, and any other queue.


def run_one(
    pipeline: str,
    root: Path,
    overrides: Sequence[str] = (),
    index: int | None = None,
    device: str | None = None,
    retries: int = 3,
) -> Path:
    """Run one cell of a matrix, or a pipeline as a cell, unless its result is in the store; return its folder.

    index: of the cell in the matrix, from 0.  Raises ClsplatError with the exit code of its run.
    """
    experiment = load_experiment(pipeline, overrides)
    if experiment is None:
        if index:
            raise ConfigError(f"{pipeline}: is a single pipeline, which has no cell {index}; leave --index out")
        checked = load(pipeline, list(overrides))
        cells = [MatrixCell(checked.settings.name, checked)]
        experiment = Experiment(checked.path, checked.settings.name, "", cells)
    elif index is None or not 0 <= index < len(experiment.cells):
        last = len(experiment.cells) - 1
        raise ConfigError(f"{pipeline}: is a matrix; expected --index from 0 to {last}, the number of a cell")
    chosen = experiment.cells[index or 0]
    store, stop, driving = Store(root), threading.Event(), threading.Event()
    with stopping_on_signals(lambda: ask_to_stop(stop, driving)):
        terms = Terms(store.now(), retries, "cell")
        wanted = wanted_cell(chosen, Scenes(store.prepared), store)
        (place,) = places("cell", [device or ""])
        cell = wanted.on(place.bits)
        store.note_sweep(f"{experiment.name}-{cell.name}", {cell.name: cell.key}, cell.key)
        driving.set()
        outcome = run_cell(cell, store, run_command(place.device, plugin_files()), terms, stop.is_set)
    if outcome.state == "stopped":
        raise Interrupted(f"cell {cell.name}: {outcome.message}; the same command goes on with it")
    if outcome.state != "published":
        error = ClsplatError(f"cell {cell.name}: {outcome.message}")
        error.exit_code = outcome.exit_code
        raise error
    result = store.folder(cell.key).result
    LOG.info("cell %s: published in %s", cell.name, result)
    return result


# Run the cells of a matrix through a store, and put their results into the folder of the matrix.


def run_sweep(
    experiment: Experiment,
    state: RunState,
    execution: Execution,
    device: str | None,
    start: Start,
) -> None:
    """Run every cell, unless its result is in the store, and write compare.html, as a run without a store does.

    device: the one of the engine inline.  A cell that fails does not stop the others; at the end a ClsplatError is
    raised with the exit code of the first one.  Raises Interrupted, Different.
    """
    store = Store(execution.store_folder or Path())
    with matrix_opened(experiment, state, start) as (status, failures):
        sweep = _Sweep(
            experiment.name, experiment.text, experiment.cells, state.out, store, failures, start == "restart"
        )
        sweep.status = status
        sweep.run(execution, device)


class _Sweep(Batch):
    """A batch whose folder is that of a matrix, with its status."""

    status: StatusFile

    def ready(self) -> None:
        self.status.enter("running")

    def tell(self, stage: str | None) -> None:
        if stage is not None:
            self.status.note(stage=stage)
            return
        self.status.note(done=len({*self.outcomes, *self.failures}), failed=self.failures.texts())
        self.status.refresh()

    def require_held(self) -> None:
        self.status.require_held()
