"""Running a pipeline, or the cells of a matrix one after the other and comparing them."""

import json
import logging
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat import terminal
from clsplat.compare.page import write_comparison
from clsplat.errors import ClsplatError, ConfigError, DataError, Interrupted, OutputError, as_clsplat_error, one_line
from clsplat.files import write_text
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Cell, Experiment, load_experiment
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs import runner
from clsplat.training.checkpoint import first_difference

LOG = logging.getLogger("clsplat")
PAGE = "compare.html"


@dataclass(frozen=True)
class Job:
    """A checked pipeline or matrix, and the folder that it runs in."""

    work: Pipeline | Experiment
    out: Path

    @classmethod
    def open(
        cls,
        pipeline: str,
        scene: Path | None = None,
        out: Path | None = None,
        overrides: Sequence[str] = (),
        resume: bool = False,
    ) -> "Job":
        """Check a pipeline file, or a shipped one by name; `overrides` are 'stage.key=value'.  Raises ConfigError.

        out: default runs/NAME, with a number where that is another run.
        """
        changes = [*overrides, *([f"scene.path={quoted(scene)}"] if scene is not None else [])]
        if found := load_experiment(pipeline, changes):
            return cls(found, out or runner.free_folder(Path("runs") / found.name, None, resume))
        checked = load(pipeline, changes)
        return cls(checked, out or runner.free_folder(Path("runs") / checked.settings.name, checked, resume))

    @classmethod
    def resume(cls, out: Path, overrides: Sequence[str] = ()) -> "Job":
        """Take the pipeline that a run folder holds, to go on with it there.  Raises ConfigError or DataError."""
        file = out / "pipeline.yaml"
        if not file.is_file():
            raise DataError(f"{out}: has no pipeline.yaml; expected the folder of a run")
        return cls.open(str(file), None, out, overrides, resume=True)

    def describe(self, device: str | Device | None = None) -> str:
        """What would run, as lines of text.  Raises what `run` raises before it begins."""
        if isinstance(self.work, Experiment):
            return describe_matrix(self.work, self.out)
        return runner.describe(self.work, self.out, device)

    def run(self, device: str | Device | None = None, resume: bool = False) -> None:
        """Run it; what is up to date is left alone.  Raises ClsplatError; status.json tells why."""
        if isinstance(self.work, Experiment):
            run_matrix(self.work, self.out, device, resume)
        elif runner.up_to_date(self.work, self.work.preparation(self.out), self.out):
            LOG.info("%s: up to date; change a setting, or give another folder, to run again", self.out)
        else:
            run_pipeline(self.work, self.out, device, resume)


def check(pipeline: str) -> dict[str, Any]:
    """Check a pipeline file, or a shipped one by name: its path, its name, its stages or cells.  Raises ConfigError."""
    if found := load_experiment(pipeline):
        return {"path": str(found.path), "name": found.name, "cells": [cell.name for cell in found.cells]}
    checked = load(pipeline)
    return {"path": str(checked.path), "name": checked.settings.name, "stages": checked.names}


def run_pipeline(pipeline: Pipeline, out: Path, device: str | Device | None, resume: bool) -> None:
    """Run one pipeline in its folder, with a log and a progress bar.  Raises ClsplatError; status.json tells why."""
    runner.make_run_folder(out, resume)
    with (
        runner.stopping_on_signals(_stop_at_once),
        runner.failures_recorded(out),
        terminal.logging_to(out / "log.txt"),
    ):
        run = runner.open_run(pipeline, out, device)
        with terminal.progress_bar() as show:
            runner.execute(pipeline, run, resume, show)


def run_matrix(experiment: Experiment, out: Path, device: str | Device | None, resume: bool) -> None:
    """Run every cell in its folder below `out` and write compare.html; with `resume` finished cells are left alone.

    A cell that fails does not stop the others; at the end a ClsplatError is raised with the exit code of the first one.
    Interrupted stops the whole.
    """
    if resume and (out / "pipeline.yaml").exists() and "matrix" not in (read_yaml(out / "pipeline.yaml").data or {}):
        raise ConfigError(f"{out}: holds a single run, not those of a matrix; give another folder")
    runner.make_run_folder(out, resume)
    write_text(out / "pipeline.yaml", experiment.text)
    state = _State(out, len(experiment.cells))
    try:
        _run_cells(experiment, state, device, resume)
        _compare(experiment, out, state.failures)
    except BaseException as error:
        state.end(as_clsplat_error(error))  # raises it
    state.end(_first_of(state.failures, len(experiment.cells)))


def _run_cells(experiment: Experiment, state: "_State", device: str | Device | None, resume: bool) -> None:
    for number, cell in enumerate(experiment.cells, 1):
        state.write("running", done=number - 1)
        title, folder = f"cell {number} of {len(experiment.cells)}: {cell.name}", state.out / cell.name
        try:
            if resume and _finished(cell, folder):
                LOG.info("%s is done", title)
            else:
                LOG.info("%s", title)
                run_pipeline(cell.pipeline, folder, device, resume)
        except Interrupted:
            raise
        except Exception as error:
            state.failures[cell.name] = as_clsplat_error(error)
            LOG.warning("cell %s failed: %s", cell.name, one_line(state.failures[cell.name]))
    state.write("running", done=len(experiment.cells))


def describe_matrix(experiment: Experiment, out: Path) -> str:
    """What would run, a line for each cell.  Raises DataError when a scene cannot be read."""
    for scene in {c.pipeline.settings.scene for c in experiment.cells if not c.pipeline.settings.prepare}:
        scene.read(scene.folder)
    lines = []
    for cell in experiment.cells:
        state = "done" if _finished(cell, out / cell.name) else "unfinished" if (out / cell.name).exists() else ""
        lines.append(f"  {cell.name}  {state}".rstrip())
    return f"would run {len(lines)} cells in {out}:\n" + "\n".join(lines)


def _stop_at_once() -> None:
    raise KeyboardInterrupt


def quoted(folder: Path) -> str:
    """A folder as a value of `--set`, from wherever it is used.  Raises ConfigError when YAML cannot hold its name."""
    path = str(folder.resolve())
    try:
        path.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"--scene {path!r}: expected a path of UTF-8 text; rename the folder") from None
    return json.dumps(path)


def _finished(cell: Cell, folder: Path) -> bool:
    """Whether the cell was run to its end.  Raises ConfigError when that was with other settings."""
    if runner.read_status(folder).get("state") != "done":
        return False
    before = load(str(folder / "pipeline.yaml")).resolved()
    if difference := first_difference(before, cell.pipeline.resolved()):
        raise ConfigError(f"{folder}: was run with other settings: {difference}; use another folder, or those settings")
    return True


def _compare(experiment: Experiment, out: Path, failures: dict[str, ClsplatError]) -> None:
    finished = [out / cell.name for cell in experiment.cells if cell.name not in failures]
    remarks = [f"{name} failed and is not shown: {error}" for name, error in failures.items()]
    if finished:
        write_comparison(finished, out / PAGE, experiment.name, remarks)
        LOG.info("%d runs compared in %s", len(finished), out / PAGE)


def _first_of(failures: dict[str, ClsplatError], cells: int) -> ClsplatError | None:
    """The error that stands for those of the cells, with the exit code of the first."""
    if not failures:
        return None
    name, first = next(iter(failures.items()))
    whole = ClsplatError(f"{len(failures)} of {cells} cells failed; the first, {name}: {first}")
    whole.exit_code = first.exit_code
    return whole


@dataclass
class _State:
    """How far a matrix is, as its status.json tells."""

    out: Path
    cells: int
    done: int = 0  # with those that failed
    failures: dict[str, ClsplatError] = field(default_factory=dict)

    def write(self, state: str, done: int, **more: Any) -> None:
        self.done = done
        text = {
            "state": state,
            "cells": self.cells,
            "done": done,
            "failed": {name: one_line(error) for name, error in self.failures.items()},
            "process": os.getpid(),
            "time": time.time(),
            **more,
        }
        write_text(self.out / "status.json", json.dumps(text, indent=1) + "\n")

    def end(self, failure: ClsplatError | None) -> None:
        """Write the last status, and raise the failure."""
        if failure is None:
            self.write("done", self.done, exit_code=0)
            return
        state = "interrupted" if isinstance(failure, Interrupted) else "failed"
        with suppress(OutputError):  # the failure itself is what the user must see
            self.write(state, self.done, exit_code=failure.exit_code, message=one_line(failure))
        raise failure
