"""Running a pipeline, or the cells of a matrix one after the other and comparing them."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, Interrupted, in_shell
from clsplat.core.files import COMPARISON, LOG_FILE, OF_A_MATRIX, PIPELINE, STATUS, is_there, write_text
from clsplat.core.reading import sha256
from clsplat.core.signals import stop_at_once, stop_if_signalled, stopping_on_signals
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Experiment, load_experiment
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs import describe, opening, outputs, run_folder, runner
from clsplat.runs.failures import Failures, failures_recorded
from clsplat.runs.live.live import Live
from clsplat.runs.model_file import overrides_of
from clsplat.runs.opening import read_run_scene, settle
from clsplat.runs.run_folder import Start, free_folder, start_of
from clsplat.runs.runner import require_same_inputs
from clsplat.runs.state import Phase, RunState
from clsplat.runs.status import summary
from clsplat.runs.time_budget import Show, execute_within
from clsplat.sweeps.cell import identify
from clsplat.sweeps.compare.page import write_comparison
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

# Running one pipeline in its folder, with a log and a progress bar.

LOG = logging.getLogger("clsplat")


def run_pipeline(
    pipeline: Pipeline,
    out: Path,
    device: str | Device | None,
    start: Start,
    live: Live | None = None,
    minutes: float | None = None,
) -> None:
    """Run one pipeline in its folder, with a log and a progress bar.  Raises ClsplatError; status.json tells why.

    minutes: as for `Job.run`.
    """
    outputs.check_places(pipeline, RunState.read(out))
    with (
        run_folder.opened(out, start, step=0) as status,
        stopping_on_signals(stop_at_once),
        failures_recorded(status),
        terminal.logging_to(out / LOG_FILE),
    ):
        if live:
            live.follow(status)
        with terminal.counted():
            run = opening.open_run(pipeline, out, device, start, status)
            pipeline = settle(pipeline, run)
            stop_if_signalled()

        def execute(pipeline: Pipeline, run: Run, start: Start, show: Show) -> None:
            with live.showing(run) if live else nullcontext():
                runner.execute(pipeline, run, start, live.reporting(show) if live else show)

        with terminal.progress_bar(status) as show:
            if minutes is None:
                execute(pipeline, run, start, show)
            else:
                execute_within(minutes, pipeline, run, start, show, execute)
        for line in summary(out):
            LOG.debug("%s", line)  # who asked for the run shows it


MOST_MINUTES = 525_600  # a year


@dataclass(frozen=True)
class Job:
    """A checked pipeline or matrix, and the folder that it runs in."""

    work: Pipeline | Experiment
    out: Path
    start: Start

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
        """Check a pipeline file, or a shipped one by name; `overrides` are 'stage.key=value'.  Raises ConfigError.

        out: default runs/NAME, with a number where that is another run; start: "resume" goes on from the newest
        checkpoint, "restart" begins again in a folder that holds a run; execution: of a matrix, in the place of its
        own.
        """
        if out is not None:
            is_there(out)
        changes = overrides_of(overrides, scene)
        if found := load_experiment(pipeline, changes, execution):
            return cls(found, out or free_folder(Path("runs") / found.name, None, start), start)
        if execution is not None:
            raise ConfigError(f"{pipeline}: is a single run; --on is for a file with `matrix:`")
        checked = load(pipeline, changes)
        return cls(checked, out or free_folder(Path("runs") / checked.settings.name, checked, start), start)

    @classmethod
    def resume(
        cls,
        out: Path,
        overrides: Sequence[str] = (),
        scene: Path | None = None,
        execution: dict[str, Any] | None = None,
    ) -> "Job":
        """Take the pipeline that a run folder holds, to go on with it there.  Raises ConfigError or DataError.

        scene: where its photographs are; default: where they were; execution: as for `open`.
        """
        file = out / PIPELINE
        if not file.is_file():
            again = (
                f"; give its `clsplat run … --out {in_shell(out)} --resume` again" if (out / STATUS).is_file() else ""
            )
            raise DataError(f"{out}: has no pipeline.yaml; expected the folder of a run that has begun{again}")
        return cls.open(str(file), scene, out, overrides, "resume", execution)

    def describe(self, device: str | Device | None = None) -> str:
        """What would run, as lines of text, of a single run with a rough range of the time that it takes.

        Raises what `run` raises before it begins.
        """
        if isinstance(self.work, Experiment):
            return describe_matrix(self.work, self.out, device, self.start)
        return describe.describe(self.work, self.out, device, self.start, with_time=True)

    def run(self, device: str | Device | None = None, live: int | None = None, minutes: float | None = None) -> None:
        """Run it; what is up to date is left alone.  Raises ClsplatError; status.json tells why.

        live: the port of a live preview, 0 for any; None: there is none.  minutes: that it takes, from when its
        photographs are read, in as many steps as fit.
        """
        if minutes is not None and not 0 < minutes <= MOST_MINUTES:
            raise ConfigError(f"--minutes {minutes:g}: expected a number of minutes above 0, up to {MOST_MINUTES:,}")
        if minutes is not None and isinstance(self.work, Experiment):
            raise ConfigError(
                "--minutes: expected a single run; a matrix has several: give optimize.steps in its cells"
            )
        state = RunState.read(self.out)
        if minutes is not None and self.start == "resume" and state.phase >= Phase.BEGUN:
            raise ConfigError("--minutes is for a new run, whose steps it chooses; leave it out to go on with this one")
        with previewed(live) as preview:
            if isinstance(self.work, Experiment):
                run_matrix(self.work, self.out, device, self.start, preview)
            elif start := start_of(self.work, state, self.start):
                folder = self.work.settings.scene.folder
                if start == "resume" and not folder.exists():
                    remedy = f"`clsplat resume {in_shell(self.out)} --scene DIR` says where they are now"
                    raise DataError(f"{self.out}: the folder of its photographs, {folder}, is missing; {remedy}")
                run_pipeline(self.work, self.out, device, start, preview, minutes)
            else:
                _require_same_photographs(self.work, self.out)
                LOG.info("%s: up to date: its outputs are whole; change a setting or the folder to run again", self.out)


def _require_same_photographs(pipeline: Pipeline, out: Path) -> None:
    """Raise ConfigError where those of a run that is done have changed since; prepared ones are noted with it."""
    scene = pipeline.settings.scene
    if not pipeline.settings.prepare and scene.folder.exists():
        _, identity = identify(scene, sha256)
        require_same_inputs(scene.folder, identity, out)


@contextmanager
def previewed(port: int | None) -> Iterator[Live | None]:
    """Serve a live preview for the block, and say where; None: without one.  Raises ConfigError."""
    if port is None:
        yield None
        return
    with Live(port) as live:
        terminal.remark(live.text)  # not in the log, which others may read: its address is a secret
        yield live


def run_matrix(
    experiment: Experiment, out: Path, device: str | Device | None, start: Start, live: Live | None = None
) -> None:
    """Run every cell in its folder below `out` and write compare.html; a resumed matrix leaves finished cells alone.

    A cell that fails does not stop the others; at the end a ClsplatError is raised with the exit code of the first one.
    Interrupted stops the whole.
    """
    done = done_cells(experiment, out, start)  # before anything changes in the folder
    with matrix_opened(experiment, out, start) as (status, failures):
        status.enter("running")
        for number, cell in enumerate(status.counted(experiment.cells, "cells", len(experiment.cells)), 1):
            title = f"cell {number} of {len(experiment.cells)}: {cell.name}"
            status.note(stage=cell.name)
            LOG.info("%s is done" if cell.name in done else "%s", title)
            try:
                with failures.kept(cell.name):
                    if cell.name not in done:
                        run_pipeline(cell.pipeline, out / cell.name, device, start, live)
            except Interrupted as stopped:
                raise Interrupted(f"stopped in {title}; `clsplat resume {in_shell(out)}` goes on with it") from stopped
            status.note(done=number, failed=failures.texts())
            status.refresh()


@contextmanager
def matrix_opened(experiment: Experiment, out: Path, start: Start) -> Iterator[tuple[StatusFile, Failures]]:
    """Hold the folder of a matrix while its cells run; at the end write compare.html.

    Raises a ClsplatError with the exit code of the first cell that is among the failures at the end.
    """
    check_matrix_folder(out)
    count, failures = len(experiment.cells), Failures("cells")
    with run_folder.opened(out, start, cells=count, done=0, failed={}) as status, failures_recorded(status):
        write_text(out / PIPELINE, experiment.text)
        yield status, failures
        status.require_held()
        compare(experiment, out, failures)
        if failures:
            raise failures.whole(count)
        status.end("done", exit_code=0)


def done_cells(experiment: Experiment, out: Path, start: Start) -> list[str]:
    """Return the names of the cells that a resumed matrix leaves alone: they are done, and whole.

    Raises ConfigError where one was run with other settings.
    """
    states = [(cell, RunState.read(out / cell.name)) for cell in experiment.cells if start == "resume"]
    for cell, state in states:
        state.require_same(cell.pipeline)
    return [cell.name for cell, state in states if state.is_whole(cell.pipeline)]


def check_matrix_folder(out: Path) -> None:
    """Raise ConfigError when the folder holds a single run, or files of others under the names of a matrix."""
    outputs.check_names(RunState.read(out), OF_A_MATRIX)
    if (out / PIPELINE).exists() and "matrix" not in (read_yaml(out / PIPELINE).data or {}):
        raise ConfigError(f"{out}: holds a single run, not those of a matrix; give another folder")


def describe_matrix(experiment: Experiment, out: Path, device: str | Device | None, start: Start) -> str:
    """What would run, a line for each cell.

    Raises a ClsplatError with the exit code of the first cell that the run would refuse.
    """
    check_matrix_folder(out)
    run_folder.check_run_folder(RunState.read(out), start)
    describe.tell_of_waiting(out)
    done, lines, refusals = done_cells(experiment, out, start), [], Failures("cells")
    read = cache(read_run_scene)  # each distinct scene once
    for cell in experiment.cells:
        state = "done" if cell.name in done else "unfinished" if (out / cell.name).exists() else ""
        try:
            if state != "done":
                describe.describe(cell.pipeline, out / cell.name, device, start, read)
        except ClsplatError as error:
            refusals[cell.name] = error
        lines.append(f"  {cell.name}  {state}".rstrip())
    if refusals:
        raise refusals.whole(len(lines), "would fail")
    return f"would run {len(lines)} cells in {out}:\n" + "\n".join(lines)


def compare(experiment: Experiment, out: Path, failures: dict[str, ClsplatError]) -> None:
    """Write the page that compares the cells that have finished.  Raises what `write_comparison` raises."""
    finished = [out / cell.name for cell in experiment.cells if cell.name not in failures]
    remarks = [f"{name} failed and is not shown: {error}" for name, error in failures.items()]
    if finished:
        write_comparison(finished, out / COMPARISON, experiment.name, remarks)
        LOG.info("%d runs compared in %s", len(finished), out / COMPARISON)
