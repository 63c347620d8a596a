"""Workers as jobs of SLURM, by dask-jobqueue, which need not be installed."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from clsplat.cluster.library import LOOPBACK, security
from clsplat.errors import ConfigError, DeviceError, one_line
from clsplat.pipeline.execution import Execution, Slurm

try:
    from dask_jobqueue.slurm import SLURMCluster
except ImportError:
    raise ConfigError("engine slurm needs dask-jobqueue: pip install 'clsplat[slurm]'") from None

NOTICE = "--signal=B:TERM@120"  # seconds before the end of its time, in which the cell of a job saves its state


def cluster(execution: Execution, keys: Slurm, logs: Path) -> Any:
    """Return a cluster of jobs, none of which is submitted.  logs: the folder of what they print.

    Raises ConfigError where SLURM is not on this machine, DeviceError where it would refuse the jobs.
    """
    if (sbatch := shutil.which("sbatch")) is None:
        raise ConfigError("engine slurm: sbatch is not on this machine; run the sweep where jobs are submitted")
    found = jobs(execution, keys, logs)
    with found._dummy_job.job_file() as script:
        tried = subprocess.run([sbatch, "--test-only", script], capture_output=True, encoding="utf-8", check=False)
    if tried.returncode:
        found.close()
        raise DeviceError(f"engine slurm: {one_line(tried.stderr)}; look at the keys of execution.slurm")
    return found


def are_waiting(found: Any) -> bool:
    """Whether a job of a cluster is in the queue; those that ended are forgotten, so that they are submitted again.

    Dask knows of the end of a job by its worker alone, which may not have come.
    """
    words = ["squeue", "--me", "--noheader", "--format=%i"]
    told = subprocess.run(words, capture_output=True, encoding="utf-8", check=False)
    if told.returncode:  # SLURM does not answer just now
        return True
    for name, job in list(found.workers.items()):
        if job.job_id and str(job.job_id) not in told.stdout.split():
            found.workers.pop(name, None)
    return any(job.job_id for job in found.workers.values())


def jobs(execution: Execution, keys: Slurm, logs: Path) -> Any:
    """Return the cluster, whose `job_script()` is what would be submitted for a worker."""
    notice = [] if any(one.startswith("--signal") for one in keys.options) else [NOTICE]
    certificates = security(execution.tls)
    return SLURMCluster(
        cores=keys.cores,
        memory=keys.memory,
        walltime=keys.walltime,
        queue=keys.partition,
        account=keys.account,
        interface=keys.interface,
        processes=1,
        job_name="clsplat",
        job_extra_directives=[*keys.options, *notice],
        python=f"exec {shlex.quote(sys.executable)}",  # so that signals reach the worker, not a shell around it
        worker_command="clsplat.cluster.slurm_worker",
        log_directory=shlex.quote(str(logs)),
        security=certificates,
        scheduler_options={"dashboard_address": f"{LOOPBACK}:0"},
        silence_logs="critical",
    )
