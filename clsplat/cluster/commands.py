"""Run what a command was given: a matrix through a store, where its `execution` has one."""

from pathlib import Path

from clsplat.errors import ConfigError
from clsplat.opencl.device import Device
from clsplat.pipeline.matrix import Experiment
from clsplat.runs.experiment import Job


def run_job(job: Job, device: str | Device | None, live: int | None = None, minutes: float | None = None) -> Path:
    """Run a job, and return its folder; arguments as for `Job.run`.  Raises ClsplatError."""
    work = job.work
    if not isinstance(work, Experiment) or work.execution.keeps is None:
        job.run(device, live, minutes)
        return job.out
    if live is not None or minutes is not None:
        raise ConfigError("--live and --minutes are for one run; the cells of a store run in other processes")
    if isinstance(device, Device):
        raise ConfigError("expected the name of a device: the cells of a store run in other processes")
    if device is not None and work.execution.has_workers:
        raise ConfigError(
            "--device: a scheduler has the devices that its workers offer, by `clsplat worker --device NAME`"
        )
    from clsplat.cluster.sweep import run_sweep  # and what tells devices apart, which a single run does not need

    run_sweep(work, job.out, work.execution, device, job.start)
    return job.out
