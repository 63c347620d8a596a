"""Run a pipeline, or run the cells of a matrix one after another and compare them."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, Interrupted, shell_quote, shorten
from clsplat.core.files import (
    COMPARISON,
    LOG_FILE,
    MATRIX_FILES,
    PIPELINE,
    PREPARED,
    STATUS,
    STORE,
    UNDISTORTED,
    path_exists,
    write_text,
)
from clsplat.core.reading import sha256
from clsplat.core.signals import stop_at_once, stop_if_signaled, stopping_on_signals
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Experiment, load_experiment
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs import describe, opening, outputs, run_folder, runner
from clsplat.runs.failures import Failures, recording_failures
from clsplat.runs.live.live import Live
from clsplat.runs.model_file import with_scene_path
from clsplat.runs.opening import read_run_scene, resolve_choices
from clsplat.runs.run_folder import Start, choose_start, find_free_folder
from clsplat.runs.runner import require_same_inputs
from clsplat.runs.state import Phase, RunState
from clsplat.runs.status import summarize_run
from clsplat.runs.time_budget import Show, execute_within
from clsplat.sweeps.cell import identify
from clsplat.sweeps.compare.page import write_comparison
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")


def run_pipeline(
    pipeline: Pipeline,
    state: RunState,
    device: str | Device | None,
    start: Start,
    live: Live | None = None,
    minutes: float | None = None,
) -> None:
    """Run a pipeline in its folder, with a log and a progress bar.

    state: the state of the folder before the run.  minutes: as for `Job.run`.  Raises ClsplatError, and writes it to
    status.json.
    """
    outputs.check_output_paths(pipeline, state)
    out = state.out
    with (
        run_folder.open_run_folder(state, start, step=0) as status,
        stopping_on_signals(stop_at_once),
        recording_failures(status),
        terminal.logging_to(out / LOG_FILE),
    ):
        if live:
            live.follow(status)
        with terminal.counts_on_terminal():
            run = opening.open_run(pipeline, out, device, start, status)
            pipeline = resolve_choices(pipeline, run)
            stop_if_signaled()

        def execute(pipeline: Pipeline, run: Run, start: Start, show: Show) -> None:
            with live.showing(run) if live else nullcontext():
                runner.execute(pipeline, run, start, live.reporting(show) if live else show)

        with terminal.progress_bar(status) as show:
            if minutes is None:
                execute(pipeline, run, start, show)
            else:
                execute_within(minutes, pipeline, run, start, show, execute)
        for line in summarize_run(out):
            LOG.debug("%s", line)  # the caller prints it


MAX_MINUTES = 525_600  # a year


@dataclass(frozen=True)
class Job:
    """A checked pipeline or matrix, and the folder in which it runs."""

    work: Pipeline | Experiment
    state: RunState  # state of the folder before the run
    start: Start

    @property
    def out(self) -> Path:
        """The folder in which the job runs."""
        return self.state.out

    @classmethod
    def open(
        cls,
        pipeline: str,
        scene: Path | None = None,
        out: Path | None = None,
        overrides: Sequence[str] = (),
        start: Start = "new",
        execution: dict[str, Any] | None = None,
    ) -> "Job":
        """Return the job of a checked pipeline or matrix.  Raises ConfigError.

        pipeline: a file, or the name of a shipped pipeline.
        out: the run folder; default: runs/NAME, with a number appended if that folder has another run.
        overrides: settings in the form 'stage.key=value'.
        start: "resume" continues from the newest checkpoint; "restart" replaces the run in the folder with a new one.
        execution: replaces the `execution` of a matrix.
        """
        state = None
        if out is not None:
            path_exists(out)  # raises an error if the name is invalid
            state = RunState.read(out)
        return cls._open(pipeline, state, scene, overrides, start, execution)

    @classmethod
    def _open(
        cls,
        pipeline: str,
        state: RunState | None,
        scene: Path | None,
        overrides: Sequence[str],
        start: Start,
        execution: dict[str, Any] | None,
    ) -> "Job":
        overrides = with_scene_path(overrides, scene)
        experiment = load_experiment(pipeline, overrides, execution)
        if experiment is None and execution is not None:
            raise ConfigError(f"{pipeline}: is a single run, and --on is for a file with `matrix:`; omit --on")
        if experiment and state and start == "resume" and execution is None and state.phase is not Phase.DONE:
            previous, current = state.status.get("store"), STORE if experiment.execution.has_store else None
            if previous not in (None, current):
                raise ConfigError(
                    f"{state.out}: was started with --on; its cells are in {shorten(str(previous))}; pass --on again"
                )
        if state:
            return cls(experiment or load(pipeline, overrides), state, start)
        if experiment:
            return cls(experiment, find_free_folder(Path("runs") / experiment.name, None, start), start)
        single = load(pipeline, overrides)
        return cls(single, find_free_folder(Path("runs") / single.settings.name, single, start), start)

    @classmethod
    def resume(
        cls,
        out: Path,
        overrides: Sequence[str] = (),
        scene: Path | None = None,
        execution: dict[str, Any] | None = None,
        steps: int | None = None,
    ) -> "Job":
        """Return a job that continues the run in a folder.  Raises ConfigError or DataError.

        scene: the new folder of the photos, if they have moved.  execution: as for `open`.  steps: the new number of
        training steps.
        """
        state = RunState.read(out)
        if PIPELINE not in state.names:
            hint = f"; run its `clsplat run … --out {shell_quote(out)} --resume` again" if STATUS in state.names else ""
            raise DataError(f"{out}: has no pipeline.yaml; expected the folder of a started run{hint}")
        if steps is not None:
            overrides = [*overrides, f"{state.steps_key}={steps}"]
            with suppress(ConfigError):  # which opening the run raises again
                if note := state.describe_longer_training():
                    LOG.warning("%s", note)
        return cls._open(str(out / PIPELINE), state, scene, overrides, "resume", execution)

    def describe(self, device: str | Device | None = None) -> str:
        """Describe what would run, as lines of text; for a single run, include a rough time estimate.

        Raises the errors that `run` raises before it starts.
        """
        if isinstance(self.work, Experiment):
            return describe_matrix(self.work, self.state, device, self.start)
        return describe.describe(self.work, self.state, device, self.start, with_time=True)

    def run(self, device: str | Device | None = None, live: int | None = None, minutes: float | None = None) -> None:
        """Run the pipeline or matrix, except for runs whose outputs are complete and up to date.

        live: the port of a live preview; 0: any free port; None: no preview.
        minutes: a time budget, which starts when the photos have been read and determines the number of steps.
        Raises ClsplatError, and writes the reason to status.json.
        """
        if minutes is not None and not 0 < minutes <= MAX_MINUTES:
            raise ConfigError(f"--minutes {minutes:g}: expected a number of minutes above 0, up to {MAX_MINUTES:,}")
        if minutes is not None and isinstance(self.work, Experiment):
            raise ConfigError("--minutes: expected a single run; for a matrix, set optimize.steps in its cells")
        if minutes is not None and self.start == "resume" and self.state.phase >= Phase.BEGUN:
            raise ConfigError("--minutes chooses the steps of a new run; omit it to continue this run")
        with live_preview(live) as preview:
            if isinstance(self.work, Experiment):
                run_matrix(self.work, self.state, device, self.start, preview)
            elif start := choose_start(self.work, self.state, self.start):
                folder = self.work.settings.scene.folder
                if start == "resume" and not folder.exists():
                    remedy = f"if you moved it, run `clsplat resume {shell_quote(self.out)} --scene DIR`"
                    raise DataError(f"{self.out}: the folder of its photos, {folder}, is missing; {remedy}")
                run_pipeline(self.work, self.state, device, start, preview, minutes)
            else:
                _require_same_photos(self.work, self.out)
                LOG.info(
                    "%s: the outputs are complete and up to date; change a setting or the folder to run again", self.out
                )


def _require_same_photos(pipeline: Pipeline, out: Path) -> None:
    """Raise ConfigError if the photos have changed since the run; photos with `prepare` steps are not checked."""
    scene = pipeline.settings.scene
    if not pipeline.settings.prepare and scene.folder.exists():
        _, identity = identify(scene, sha256)
        require_same_inputs(scene.folder, identity, out)


@contextmanager
def live_preview(port: int | None) -> Iterator[Live | None]:
    """Serve a live preview during the block, and print its address; without a port, yield None.  Raises ConfigError."""
    if port is None:
        yield None
        return
    with Live(port) as live:
        terminal.print_message(live.message)  # the address is secret, and others may read the log
        yield live


def run_matrix(
    experiment: Experiment, state: RunState, device: str | Device | None, start: Start, live: Live | None = None
) -> None:
    """Run every cell in its folder, and write compare.html.  A resumed matrix skips finished cells.

    state: the state of the matrix folder before the run.
    A failed cell does not stop the others.  At the end, a ClsplatError is raised with the exit code of the first
    failure.  Interrupted stops the entire matrix.
    """
    out = state.out
    states, done_names = read_cells(experiment, out, start)
    with open_matrix(experiment, state, start) as (status, failures):
        status.enter("running")
        for number, cell in enumerate(status.counted(experiment.cells, "cells", len(experiment.cells)), 1):
            title = f"cell {number} of {len(experiment.cells)}: {cell.name}"
            status.note(stage=cell.name)
            LOG.info("%s is done" if cell.name in done_names else "%s", title)
            try:
                with failures.recording(cell.name):
                    if cell.name not in done_names:
                        run_pipeline(cell.pipeline, states[cell.name], device, start, live)
            except Interrupted as error:
                raise Interrupted(f"stopped in {title}; `clsplat resume {shell_quote(out)}` continues it") from error
            status.note(done=number, failed=failures.messages())
            status.refresh()


@contextmanager
def open_matrix(experiment: Experiment, state: RunState, start: Start) -> Iterator[tuple[StatusFile, Failures]]:
    """Lock the folder of a matrix while its cells run; write compare.html at the end.

    Raises a ClsplatError with the exit code of the first failed cell.
    """
    check_matrix_folder(state)
    count, failures, out = len(experiment.cells), Failures("cells"), state.out
    with run_folder.open_run_folder(state, start, cells=count, done=0, failed={}) as status, recording_failures(status):
        write_text(out / PIPELINE, experiment.text)
        yield status, failures
        status.require_lock()
        compare(experiment, out, failures)
        if failures:
            raise failures.summary(count)
        status.end("done", exit_code=0)


def read_cells(experiment: Experiment, out: Path, start: Start) -> tuple[dict[str, RunState], set[str]]:
    """Return the state of each cell's folder, by cell name, and the names of the cells that a resumed matrix skips.

    Raises ConfigError if the run of a finished cell had other settings.
    """
    states = {cell.name: RunState.read(out / cell.name) for cell in experiment.cells}
    resumed_cells = experiment.cells if start == "resume" else []
    for cell in resumed_cells:
        states[cell.name].require_same(cell.pipeline)
    return states, {cell.name for cell in resumed_cells if states[cell.name].is_complete(cell.pipeline)}


def check_matrix_folder(state: RunState) -> None:
    """Raise ConfigError if the folder has a single run, or files with names that a matrix would write."""
    outputs.check_names(state, MATRIX_FILES)
    outputs.require_inside(state.out, [state.out / PREPARED, state.out / UNDISTORTED])  # cells share them
    out = state.out
    if PIPELINE in state.names and "matrix" not in (read_yaml(out / PIPELINE).data or {}):
        raise ConfigError(f"{out}: has a single run, not a matrix; use another folder")


def describe_matrix(experiment: Experiment, state: RunState, device: str | Device | None, start: Start) -> str:
    """Describe what would run, one line per cell.

    Raises a ClsplatError with the exit code of the first cell that could not run.
    """
    check_matrix_folder(state)
    run_folder.check_run_folder(state, start)
    describe.check_unused(state.out)
    cells, done_names = read_cells(experiment, state.out, start)
    lines, refusals = [], Failures("cells")
    read_once = cache(read_run_scene)  # read each distinct scene once
    for cell in experiment.cells:
        progress = "done" if cell.name in done_names else "unfinished" if (state.out / cell.name).exists() else ""
        try:
            if progress != "done":
                describe.describe(cell.pipeline, cells[cell.name], device, start, read_once)
        except ClsplatError as error:
            refusals[cell.name] = error
        lines.append(f"  {cell.name}  {progress}".rstrip())
    if refusals:
        raise refusals.summary(len(lines), "would fail")
    return f"would run {len(lines)} cells in {state.out}:\n" + "\n".join(lines)


def compare(experiment: Experiment, out: Path, failures: dict[str, ClsplatError]) -> None:
    """Write compare.html, which compares the finished cells.  Raises the errors of `write_comparison`."""
    finished_folders = [out / cell.name for cell in experiment.cells if cell.name not in failures]
    remarks = [f"{name} failed and is not shown: {error}" for name, error in failures.items()]
    if finished_folders:
        write_comparison(finished_folders, out / COMPARISON, experiment.name, remarks)
        LOG.info("%d runs compared in %s", len(finished_folders), out / COMPARISON)
