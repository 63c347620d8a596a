"""Run cells on an engine, store their results, and copy these to folders with the names of the cells."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, Interrupted
from clsplat.core.files import PIPELINE, STORE, raising_output_error
from clsplat.core.progress import ItemCounter
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
from clsplat.runs.state import Phase, RunState, read_sums, try_sha256
from clsplat.sweeps.cell import CellRun, Scenes
from clsplat.sweeps.child import plugin_files, run_command
from clsplat.sweeps.devices import find_slots
from clsplat.sweeps.engines import Dispatcher, Engine, InlineEngine, PendingCell
from clsplat.sweeps.experiment import open_matrix
from clsplat.sweeps.store import ERRORS, LEASE, MANIFEST, Store, copy_files, link_or_copy
from clsplat.sweeps.task import CellOptions, Outcome, run_cell
from clsplat.training import checkpoint
from clsplat.training.stage import Training
from clsplat.training.status import StatusFile, read_status


def copy_result(source: Path, target: Path) -> None:
    """Copy the folder of a result, by hard links except for files that a run appends to.  Raises OutputError.

    The manifest is copied last, so that it marks a complete copy.
    """
    with raising_output_error(target):
        for file in (target / MANIFEST, *checkpoint.list_files(target)):  # the checkpoints may belong to another run
            file.unlink(missing_ok=True)
        copy_files(source, target, {LEASE, ERRORS, MANIFEST})
        link_or_copy(source / MANIFEST, target / MANIFEST)


def has_result(source: Path, target: Path) -> bool:
    """Return whether `target` contains a complete and unchanged copy of the result in `source`.

    Raises ConfigError if the run in `target` was continued with other settings.
    """
    copied_hash = None
    with suppress(DataError, KeyError, TypeError):
        copied_hash = read_json(target / MANIFEST)["files"][PIPELINE]
    if copied_hash and try_sha256(target / PIPELINE) not in (None, copied_hash):
        raise ConfigError(
            f"{target}: the run was continued with other settings after the sweep; move that folder elsewhere, "
            "and run the sweep again with --resume"
        )
    state = RunState.read(target)
    return state.phase is Phase.DONE and state.sums == read_sums(source) and not state.bad_files


PROGRESS_INTERVAL_S = 2.0  # time between two reads of the cells' status files
MAX_NAMES = 4  # number of cells in the progress line

LOG = logging.getLogger("clsplat")


@dataclass
class Batch:
    """A set of cells that run together, with their progress and results."""

    name: str
    text: str  # distinguishes batches with the same name
    cells: Sequence[matrix.Cell]
    out: Path  # folder that receives a subfolder with the result of each cell
    store: Store
    failures: Failures
    overwrites: bool = False  # whether the subfolders are replaced even if they contain the result already
    running: dict[str, CellRun] = field(default_factory=dict)
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _keys: dict[str, str] = field(default_factory=dict)
    _stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._steps = {cell.name: count_steps(cell.pipeline) for cell in self.cells}
        self._counter, self._last_report = ItemCounter("steps", sum(self._steps.values())), time.monotonic()

    def before_first_cell(self) -> None:
        """Prepare for the first cell.  This is called once, before that cell starts."""

    def on_change(self, started_cell: str | None) -> None:
        """Handle the start or the end of a cell.  started_cell: its name; None: a cell has ended."""

    def require_lock(self) -> None:
        """Raise OutputError if another process has taken over the folder."""

    def run(self, execution: Execution, device: str | None) -> None:
        """Run every cell whose result is not in the store, and record the failed cells in `failures`.

        device: name of the only device to use; None: the devices of `execution`.  Raises Interrupted, BitsMismatch.
        """
        has_started = threading.Event()
        with stopping_on_signals(lambda: ask_to_stop(self._stop, has_started)), terminal.counts_on_terminal():
            pending_cells = self._pending_cells()
            if not pending_cells:
                self.before_first_cell()
                return
            with _open_engine(execution, self.store, device, self._is_stopped) as engine:
                options = CellOptions(self.store.now(), execution.retries)
                dispatcher = Dispatcher(
                    self.store, engine, execution.placement.bits == "same", options, self._stop.is_set
                )
                has_started.set()
                self._dispatch(dispatcher, pending_cells)

    def _report_progress(self) -> None:
        """Read the progress of running cells from their files, and report it, at most once per interval."""
        if time.monotonic() - self._last_report < PROGRESS_INTERVAL_S:
            return
        self._last_report = time.monotonic()
        completed_steps, progress = sum(self._steps[name] for name in self.outcomes), []
        for name, cell in self.running.items():
            newest = max(self.store.folder(cell.key).attempts(), key=lambda attempt: attempt.last_beat, default=None)
            step = read_status(newest.path).get("step") if newest else 0
            if isinstance(step, int):
                completed_steps += step
                progress.append(f"{name} {step}/{self._steps[name]}")
        names = ", ".join([*progress[:MAX_NAMES], *(["…"] if len(progress) > MAX_NAMES else [])])
        self._counter.label = f"steps ({names})" if progress else "steps"
        self._counter.reach(min(completed_steps, self._counter.total))

    def _is_stopped(self) -> bool:
        """Report progress, since the inline engine calls this regularly; return whether a signal has arrived."""
        self._report_progress()
        return self._stop.is_set()

    def _pending_cells(self) -> list[PendingCell]:
        """Return the cells without an outcome.  If the scene of a cell cannot be read, record a failure instead."""
        scenes, pending_cells = Scenes(self.store.prepared), []
        for cell in self.cells:
            if cell.name in self.outcomes:
                continue
            with self.failures.recording(cell.name):
                pending_cells.append(prepare_cell(cell, scenes, self.store))
        return pending_cells

    def _dispatch(self, dispatcher: Dispatcher, pending_cells: Sequence[PendingCell]) -> None:
        dispatcher.on_end, dispatcher.poll = self._record_end, self._report_progress

        def note_start(cell: CellRun) -> None:
            if dispatcher.is_same and not self._keys:  # so that `clsplat status` shows waiting cells
                for pending in pending_cells:
                    self._keys[pending.cell.name] = pending.in_class(cell.spec["bits"]).key
                    with suppress(ClsplatError):  # reported when that cell runs
                        self.store.add(pending.in_class(cell.spec["bits"]))
            self._record_start(cell)

        dispatcher.on_start = note_start
        self.before_first_cell()
        dispatcher.run(pending_cells)

    def _record_start(self, cell: CellRun) -> None:
        if self._keys.get(cell.name) != cell.key or not self.running:
            self._keys[cell.name] = cell.key
            self.store.note_sweep(self.name, self._keys, self.text)
        self.running[cell.name] = cell
        self.on_change(cell.name)
        number = len(self.outcomes) + len(self.running)
        LOG.info("cell %d of %d: %s", number, len(self.cells), cell.name)

    def _record_end(self, cell: CellRun, outcome: Outcome) -> None:
        self.running.pop(cell.name, None)
        if outcome.state == "stopped" and self._stop.is_set():
            return
        if outcome.state == "published":
            self._copy(cell)
        else:
            error = Interrupted(outcome.message) if outcome.state == "stopped" else ClsplatError(outcome.message)
            error.exit_code = outcome.exit_code
            self.failures.note(cell.name, error)
        self.outcomes[cell.name] = outcome
        self.on_change(None)

    def _copy(self, cell: CellRun) -> None:
        """Copy the result of a cell to the folder with the cell's name, unless it is there already."""
        result, target = self.store.folder(cell.key).result, self.out / cell.name
        with self.failures.recording(cell.name):
            if self.overwrites or not has_result(result, target):
                self.require_lock()
                copy_result(result, target)


def ask_to_stop(stop: threading.Event, has_started: threading.Event) -> None:
    """Let running cells save their state and stop.

    The program stops at once if no cell has started yet, or if this is the second signal.
    """
    if stop.is_set() or not has_started.is_set():
        stop_at_once()
    stop.set()


@contextmanager
def _open_engine(
    execution: Execution, store: Store, device: str | None, is_stopped: Callable[[], bool]
) -> Iterator[Engine]:
    configured_names = None if execution.devices == "auto" else execution.devices
    if execution.engine == "inline":
        device_names = [device] if device else configured_names[:1] if configured_names else [""]
        engine: Engine = InlineEngine(store, find_slots("inline", device_names)[0], is_stopped)
    else:
        from clsplat.sweeps import dask  # Dask may not be installed

        engine = dask.open_engine(execution, store, [device] if device else configured_names)
    try:
        yield engine
    finally:
        engine.close()


def prepare_cell(cell: matrix.Cell, scenes: Scenes, store: Store) -> PendingCell:
    """Run the `prepare` steps of a cell, and return the cell, ready for a device.

    Raises ConfigError, DataError, and the errors of the steps.
    """
    if planned_steps := check_preparation(cell.pipeline, store.prepared.parent / cell.name):
        prepare(planned_steps, cell.pipeline.settings.scene.folder, store.prepared)
    facts = scenes.facts(cell.pipeline)
    cell_run = CellRun.from_pipeline(cell.name, cell.pipeline, facts.digest, bits="")
    return PendingCell(cell_run, count_steps(cell.pipeline) * facts.pixels)


def count_steps(pipeline: Pipeline) -> int:
    """Return the total number of training steps of a pipeline."""
    return sum(stage.steps for stage in pipeline.stages if isinstance(stage, Training))


# A single cell, for `sbatch --array` and other job queues.


def run_one(
    pipeline: str,
    root: Path,
    overrides: Sequence[str] = (),
    index: int | None = None,
    device: str | None = None,
    retries: int = 3,
) -> Path:
    """Run a cell of a matrix, or a pipeline as a cell, unless the store has its result; return the result's folder.

    root: the folder of the store.  index: index of the cell in the matrix.  Raises ClsplatError with the exit
    code of the run.
    """
    experiment = load_experiment(pipeline, overrides)
    if experiment is None:
        if index:
            raise ConfigError(f"{pipeline}: is a single pipeline without cell {index}; remove --index")
        single_pipeline = load(pipeline, list(overrides))
        cells = [MatrixCell(single_pipeline.settings.name, single_pipeline)]
        experiment = Experiment(single_pipeline.path, single_pipeline.settings.name, "", cells)
    elif index is None or not 0 <= index < len(experiment.cells):
        last_index = len(experiment.cells) - 1
        raise ConfigError(f"{pipeline}: is a matrix; select a cell with --index 0 to {last_index}")
    matrix_cell = experiment.cells[index or 0]
    store, stop, has_started = Store(root), threading.Event(), threading.Event()
    with stopping_on_signals(lambda: ask_to_stop(stop, has_started)):
        options = CellOptions(store.now(), retries, "cell")
        pending = prepare_cell(matrix_cell, Scenes(store.prepared), store)
        (slot,) = find_slots("cell", [device or ""])
        cell = pending.in_class(slot.bits)
        store.note_sweep(f"{experiment.name}-{cell.name}", {cell.name: cell.key}, cell.key)
        has_started.set()
        outcome = run_cell(cell, store, run_command(slot.device, plugin_files()), options, stop.is_set)
    if outcome.state == "stopped":
        raise Interrupted(f"cell {cell.name}: {outcome.message}; continue with the same command")
    if outcome.state != "published":
        error = ClsplatError(f"cell {cell.name}: {outcome.message}")
        error.exit_code = outcome.exit_code
        raise error
    result = store.folder(cell.key).result
    LOG.info("cell %s: published in %s", cell.name, result)
    return result


def run_sweep(
    experiment: Experiment,
    state: RunState,
    execution: Execution,
    device: str | None,
    start: Start,
) -> None:
    """Run every cell of a matrix whose result is not in the store, and write compare.html.

    device: name of the only device to use; None: the devices of `execution`.  A failed cell does not stop the others;
    at the end, a ClsplatError is raised with the exit code of the first failure.  Raises Interrupted, BitsMismatch.
    """
    store = Store(execution.store_folder(state.out))
    with open_matrix(experiment, state, start) as (status, failures):
        status.note(store=str(store.root) if execution.store else STORE)
        sweep = _Sweep(
            experiment.name, experiment.text, experiment.cells, state.out, store, failures, start == "restart"
        )
        sweep.status = status
        for cell in experiment.cells if start == "resume" else ():
            if RunState.read(state.out / cell.name).is_complete(cell.pipeline):  # whichever machine ran it
                sweep.outcomes[cell.name] = Outcome("published")
        sweep.run(execution, device)


class _Sweep(Batch):
    """The cells of a matrix, with a status file in the folder of the matrix."""

    status: StatusFile

    def before_first_cell(self) -> None:
        self.status.enter("running")
        self.on_change(None)

    def on_change(self, started_cell: str | None) -> None:
        if started_cell is not None:
            self.status.note(stage=started_cell)
            return
        self.status.note(done=len({*self.outcomes, *self.failures}), failed=self.failures.messages())
        self.status.refresh()

    def require_lock(self) -> None:
        self.status.require_lock()
