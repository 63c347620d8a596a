"""Running a pipeline, or the cells of a matrix one after the other and comparing them."""

import json
import logging
import os
import time
from pathlib import Path

from clsplat import runner, terminal
from clsplat.compare.page import write_comparison
from clsplat.errors import ClsplatError, ConfigError, Interrupted, MemoryLimitError
from clsplat.files import write_text
from clsplat.matrix import Cell, Experiment
from clsplat.pipeline import Pipeline, load
from clsplat.training.checkpoint import first_difference
from clsplat.yaml_file import read_yaml

LOG = logging.getLogger("clsplat")
PAGE = "compare.html"


def run_pipeline(pipeline: Pipeline, out: Path, device: str | None, resume: bool) -> None:
    """Run one pipeline in its folder, with a log and a progress bar."""
    runner.make_run_folder(out, resume)
    with terminal.logging_to(out / "log.txt"):
        try:
            state = runner.open_run(pipeline, out, device)
        except ClsplatError as error:
            runner.give_up(out, error)
            raise
        with terminal.progress_bar() as show:
            runner.execute(pipeline, state, resume, show)


def run(experiment: Experiment, out: Path, device: str | None, resume: bool) -> None:
    """Run every cell in its folder below `out` and write compare.html; with `resume` finished cells are left alone.

    A cell that fails does not stop the others; at the end a ClsplatError is raised with the exit code of the first one.
    Interrupted stops the whole.
    """
    if resume and (out / "pipeline.yaml").exists() and "matrix" not in (read_yaml(out / "pipeline.yaml").data or {}):
        raise ConfigError(f"{out}: holds a single run, not those of a matrix; give another --out")
    runner.make_run_folder(out, resume)
    write_text(out / "pipeline.yaml", experiment.text)
    failures: dict[str, ClsplatError] = {}
    for number, cell in enumerate(experiment.cells, 1):
        _status(out, "running", experiment, number - 1, failures)
        try:
            if resume and _finished(cell, out / cell.name):
                LOG.info("cell %d of %d: %s is done", number, len(experiment.cells), cell.name)
            else:
                LOG.info("cell %d of %d: %s", number, len(experiment.cells), cell.name)
                run_pipeline(cell.pipeline, out / cell.name, device, resume)
        except Interrupted:
            _status(out, "interrupted", experiment, number - 1, failures)
            raise
        except (ClsplatError, MemoryError) as error:
            failures[cell.name] = error if isinstance(error, ClsplatError) else MemoryLimitError("out of memory")
            LOG.warning("cell %s failed: %s", cell.name, failures[cell.name])
    _compare(experiment, out, failures)
    _status(out, "failed" if failures else "done", experiment, len(experiment.cells), failures)
    if failures:
        name, first = next(iter(failures.items()))
        whole = ClsplatError(f"{len(failures)} of {len(experiment.cells)} cells failed; the first, {name}: {first}")
        whole.exit_code = first.exit_code
        raise whole


def describe(experiment: Experiment, out: Path) -> str:
    """What would run, a line for each cell.  Raises DataError when a scene cannot be read."""
    for scene in {c.pipeline.settings.scene for c in experiment.cells if not c.pipeline.settings.prepare}:
        scene.read(scene.folder)
    lines = []
    for cell in experiment.cells:
        state = "done" if _finished(cell, out / cell.name) else "unfinished" if (out / cell.name).exists() else ""
        lines.append(f"  {cell.name}  {state}".rstrip())
    return f"would run {len(lines)} cells in {out}:\n" + "\n".join(lines)


def _finished(cell: Cell, folder: Path) -> bool:
    """Whether the cell was run to its end.  Raises ConfigError when that was with other settings."""
    try:
        state = json.loads((folder / "status.json").read_text())["state"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    if state != "done":
        return False
    before = load(str(folder / "pipeline.yaml")).resolved()
    if difference := first_difference(before, cell.pipeline.resolved()):
        raise ConfigError(f"{folder}: was run with other settings: {difference}; use another --out, or those settings")
    return True


def _compare(experiment: Experiment, out: Path, failures: dict[str, ClsplatError]) -> None:
    finished = [out / cell.name for cell in experiment.cells if cell.name not in failures]
    remarks = [f"{name} failed and is not shown: {error}" for name, error in failures.items()]
    if finished:
        write_comparison(finished, out / PAGE, experiment.name, remarks)
        LOG.info("%d runs compared in %s", len(finished), out / PAGE)


def _status(out: Path, state: str, experiment: Experiment, done: int, failures: dict[str, ClsplatError]) -> None:
    text = {
        "state": state,
        "cells": len(experiment.cells),
        "done": done,
        "failed": {name: str(error) for name, error in failures.items()},
        "process": os.getpid(),
        "time": time.time(),
    }
    write_text(out / "status.json", json.dumps(text, indent=1) + "\n")
