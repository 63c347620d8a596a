"""Run what a command was given: a matrix through a store, where its `execution` has one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clsplat.cluster.execution import check_execution, execution_of, values_of
from clsplat.errors import ConfigError
from clsplat.opencl.device import Device
from clsplat.pipeline.matrix import Experiment
from clsplat.runs import check as runs_check
from clsplat.runs.experiment import Job
from clsplat.runs.folders import Start


def run_job(job: Job, device: str | Device | None, live: int | None = None, minutes: float | None = None) -> Path:
    """Run a job, and return its folder; arguments as for `Job.run`.  Raises ClsplatError."""
    work = job.work
    execution = execution_of(work.execution, work.path) if isinstance(work, Experiment) else None
    if not isinstance(work, Experiment) or execution is None or execution.keeps is None:
        job.run(device, live, minutes)
        return job.out
    if live is not None or minutes is not None:
        raise ConfigError("--live and --minutes are for one run; the cells of a store run in other processes")
    if isinstance(device, Device):
        raise ConfigError("expected the name of a device: the cells of a store run in other processes")
    from clsplat.cluster.sweep import run_sweep  # and what tells devices apart, which a single run does not need

    run_sweep(work, job.out, execution, device, job.start)
    return job.out


def open_job(
    pipeline: str, scene: Path | None, out: Path | None, overrides: Sequence[str], start: Start, on: Path | None
) -> Job:
    """Open a job as `Job.open`, and check the `execution` of a matrix.  on: a file of another one.

    Raises ConfigError with the line.
    """
    job = Job.open(pipeline, scene, out, overrides, start, values_of(on))
    if isinstance(job.work, Experiment):
        execution_of(job.work.execution, job.work.path)
    return job


def check(pipeline: str) -> dict[str, Any]:
    """Check as `clsplat.runs.check`, and the `execution` of a matrix.  Raises ConfigError, DataError."""
    found = runs_check.check(pipeline)
    if "cells" in found:
        check_execution(Path(found["path"]))
    return found
