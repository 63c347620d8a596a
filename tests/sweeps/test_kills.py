"""Kills of each process of a sweep: every cell is published once, with undisturbed bits.

They take minutes: CLSPLAT_KILLS is the number of kills, over six cells where it is more than two; without it they skip,
and `test_short_kills.py` is what the suite has of them.
"""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.cells import KILLS
from tests.support.sweeps import Sweep, hashes_without_store, kill, runs_below, until, workers_below

psutil = pytest.importorskip("psutil", exc_type=ImportError)  # of Dask

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not KILLS, reason="CLSPLAT_KILLS=20 runs it: minutes")]
CELLS = 6 if KILLS > 2 else 2


@pytest.fixture(scope="module")
def expected(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("expected")
    return hashes_without_store(Sweep(folder, tiny_scene, CELLS, "inline"), folder / "out")


def remaining_runs(folder: Path) -> "list[psutil.Process]":
    """Runs of a sweep in a folder that are still there, whoever began them."""
    words = [(one, one.info["cmdline"] or []) for one in psutil.process_iter(["cmdline"])]
    return [one for one, own in words if "--attended" in own and any(str(folder) in word for word in own)]


def test_killing_workers_runs_and_drivers_loses_nothing(tiny_scene, tmp_path, expected):
    """A new checkpoint is waited for before each kill, so that all of them meet a training."""
    sweep, generator, killed = Sweep(tmp_path, tiny_scene, CELLS), random.Random(0), 0
    process, known = sweep.start(), set()
    while process.poll() is None:
        if killed < KILLS and sweep.saved() - known:
            known |= sweep.saved()
            what = generator.choice(["worker", "run", "worker", "driver"] if killed else ["worker"])
            if what == "driver":
                process.kill()
                process.communicate()
                process, killed = sweep.start(), killed + 1
            else:
                victims = workers_below(process) if what == "worker" else runs_below(process)
                killed += kill(victims if killed % 5 == 4 else victims[:1])
        time.sleep(0.05)
    assert process.returncode == 0, process.communicate()[1]
    assert sweep.models() == expected
    assert killed >= KILLS, "there were too few checkpoints to wait for"
    assert sweep.events("publish") == CELLS
    assert sweep.events("start") > CELLS
    until(lambda: not remaining_runs(tmp_path), 90)
    print(f"{killed} kills, {sweep.events('start')} starts, {sweep.events('publish')} published, hashes as undisturbed")


def test_frozen_supervisor_wakes_to_the_same_bits(tiny_scene, tmp_path, expected):
    """Another one has run the cell meanwhile: there are two writers."""
    sweep = Sweep(tmp_path, tiny_scene, CELLS, "inline")
    words = [sys.executable, "-m", "clsplat", "cell", str(sweep.file), "--index", "0", "--store", str(sweep.store.root)]
    first = subprocess.Popen(words)
    until(lambda: bool(sweep.saved()))
    first.send_signal(signal.SIGSTOP)
    assert subprocess.run(words).returncode == 0
    first.send_signal(signal.SIGCONT)
    assert first.wait(300) == 0
    assert (sweep.events("publish"), sweep.events("second")) == (1, 1)
    (model,) = sweep.store.root.glob("cells/*/result/point_cloud.ply")
    assert model.parent.joinpath("manifest.json").is_file()


@pytest.mark.parametrize("engine", ["inline", "local"])
def test_signal_saves_and_the_command_resumes_elsewhere(tiny_scene, tmp_path, expected, engine):
    """SIGTERM for the command alone, Ctrl-C for all processes of the terminal; then the store has moved."""
    sweep = Sweep(tmp_path, tiny_scene, CELLS, engine)
    process = sweep.start()
    until(lambda: bool(sweep.saved()))
    if engine == "inline":
        process.send_signal(signal.SIGTERM)
    else:
        os.killpg(process.pid, signal.SIGINT)
    errors = process.communicate()[1]
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert not remaining_runs(tmp_path)
    moved = sweep.store.root.rename(tmp_path / "elsewhere")  # as another mount point would
    sweep.on.write_text(sweep.on.read_text().replace(str(sweep.store.root), str(moved)))
    process = sweep.start()
    errors = process.communicate()[1]
    assert process.returncode == 0, errors
    assert sweep.models() == expected
    sweep.store.root = moved
    assert any(event.get("from") for event in sweep.store.events()), "it went on from a checkpoint"


@contextmanager
def scheduler(port: int, processes: list["subprocess.Popen[str]"]) -> Iterator["subprocess.Popen[bytes]"]:
    """A scheduler on a port; at the end all processes are ended, and it as the last."""
    words = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    process = subprocess.Popen([sys.executable, *words], stderr=subprocess.DEVNULL)
    try:
        time.sleep(5)  # until it listens
        yield process
    finally:
        for item in (*reversed(processes), process):
            item.terminate()
            item.wait(60)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def offer(port: int) -> "subprocess.Popen[str]":
    words = [sys.executable, "-m", "clsplat", "worker", "--scheduler", f"dask://127.0.0.1:{port}"]
    return subprocess.Popen(words, text=True)


def test_cells_resume_on_another_worker(tiny_scene, tmp_path, expected):
    port, processes = free_port(), []
    sweep = Sweep(tmp_path, tiny_scene, CELLS, f"dask://127.0.0.1:{port}")
    with scheduler(port, processes):
        processes += [offer(port), sweep.start()]
        until(lambda: bool(sweep.saved()))
        kill([*psutil.Process(processes[0].pid).children(recursive=True), psutil.Process(processes[0].pid)])
        processes.append(offer(port))
        errors = processes[1].communicate()[1]
        assert processes[1].returncode == 0, errors
        assert sweep.models() == expected
        assert sweep.events("publish") == CELLS


def test_sweep_resumes_after_its_scheduler_is_killed(tiny_scene, tmp_path, expected):
    port, processes = free_port(), []
    sweep = Sweep(tmp_path, tiny_scene, CELLS, f"dask://127.0.0.1:{port}")
    with scheduler(port, processes) as first:
        processes += [offer(port), sweep.start()]
        until(lambda: bool(sweep.saved()))
        first.kill()
        errors = processes[1].communicate(timeout=200)[1]
        assert processes[1].returncode == 4, errors
        assert "the scheduler exited; restart it, and run the sweep again with --resume" in errors
    until(lambda: not remaining_runs(tmp_path), 90)
    with scheduler(port, processes):
        processes += [offer(port), sweep.start()]
        errors = processes[-1].communicate()[1]
        assert processes[-1].returncode == 0, errors
        assert sweep.models() == expected
