"""Engine slurm: the script of a job, what is refused before one is submitted, and the worker in it."""

import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.cluster import slurm_worker
from clsplat.errors import ConfigError, DeviceError
from clsplat.pipeline.execution import Execution, Slurm

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the interface lo")
KEYS = Slurm(jobs=3, cores=4, memory="8GB", walltime="01:00:00", options=["--gres=gpu:1"], interface="lo")
EXECUTION = Execution(engine="slurm", insecure=True, slurm=KEYS)


@pytest.fixture
def slurm():
    """The module, which loads Dask; where Dask is."""
    return pytest.importorskip("clsplat.cluster.slurm", exc_type=ConfigError)


def test_the_script_of_a_job_runs_a_worker_that_signals_reach(slurm, tmp_path):
    with slurm.jobs(EXECUTION, KEYS, tmp_path / "logs") as found:
        script = found.job_script()
    options = [line.removeprefix("#SBATCH ") for line in script.splitlines() if line.startswith("#SBATCH")]
    assert {"--cpus-per-task=4", "--mem=8G", "-t 01:00:00", "--gres=gpu:1", "--signal=B:TERM@120"} <= {*options}
    assert f"-o {tmp_path}/logs/clsplat-%J.out" in options
    (command,) = [line for line in script.splitlines() if "-m " in line]
    assert shlex.split(command)[:4] == ["exec", sys.executable, "-m", "clsplat.cluster.slurm_worker"]
    own = KEYS.model_copy(update={"options": ["--signal=B:TERM@600"]})
    with slurm.jobs(EXECUTION, own, tmp_path / "logs") as found:
        assert "TERM@120" not in found.job_script()


@pytest.mark.parametrize("refuses", [True, False])
def test_jobs_that_slurm_would_refuse_end_a_sweep_at_once(slurm, tmp_path, monkeypatch, refuses):
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    sbatch = tmp_path / "sbatch"
    sbatch.write_text("#!/bin/sh\necho 'allocation failure: Invalid partition' >&2\n" + "exit 1\n" * refuses)
    sbatch.chmod(0o755)
    if refuses:
        with pytest.raises(DeviceError, match="engine slurm: allocation failure: Invalid partition; look at"):
            slurm.cluster(EXECUTION, KEYS, tmp_path / "logs")
    else:
        slurm.cluster(EXECUTION, KEYS, tmp_path / "logs").close()


def test_a_machine_without_slurm_is_told(slurm, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="sbatch is not on this machine"):
        slurm.cluster(EXECUTION, KEYS, tmp_path / "logs")


@pytest.mark.parametrize("tls", [True, False])
def test_the_worker_of_a_job_takes_what_the_queue_gives(monkeypatch, tls):
    got = []
    monkeypatch.setattr(slurm_worker, "offer", lambda *words, **options: got.append((*words, options)))
    words = ["tcp://10.0.0.1:99", "--name", "jobs-0", "--nthreads", "4", "--memory-limit", "8GB", "--interface", "ib0"]
    if tls:
        words[0] = "tls://10.0.0.1:99"
        words += ["--tls-ca-file", "a.pem", "--tls-cert", "b.pem", "--tls-key", "c.pem"]
    assert slurm_worker.main(words) == 0
    ((execution, devices, options),) = got
    assert execution.address == words[0]
    assert (execution.tls.cert if execution.tls else None) == ("b.pem" if tls else None)
    assert (devices, options) == ([""], {"name": "jobs-0", "interface": "ib0"})
    monkeypatch.setattr(slurm_worker, "offer", lambda *words, **options: [][0])
    assert slurm_worker.main(["nowhere"]) == 2


@pytest.mark.parametrize(
    ("answer", "left"),
    [("echo 7; echo 12", "ac"), ("true", "c"), ("exit 1", "abc")],
    ids=["one has ended", "all have", "no answer"],
)
def test_jobs_that_ended_are_forgotten_where_the_queue_says_so(slurm, tmp_path, monkeypatch, answer, left):
    squeue = tmp_path / "squeue"
    squeue.write_text(f"#!/bin/sh\n{answer}\n")
    squeue.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    numbers = {"a": "12", "b": "13", "c": None}  # the last is being submitted
    found = SimpleNamespace(workers={name: SimpleNamespace(job_id=number) for name, number in numbers.items()})
    assert slurm.are_waiting(found) == ("a" in left)
    assert "".join(found.workers) == left


def test_the_logs_of_jobs_have_a_folder(slurm, tmp_path):
    with slurm.jobs(EXECUTION, KEYS, tmp_path / "logs"):
        assert Path(tmp_path / "logs").is_dir()
