"""A small real sweep for tests with kills, and its processes."""

import hashlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from clsplat.pipeline.matrix import load_experiment
from clsplat.runs.state import RunState
from clsplat.sweeps import experiment
from clsplat.sweeps.store import Store

psutil = pytest.importorskip("psutil", exc_type=ImportError)  # of Dask

PIPELINE = """\
stages:
  - init: {count: 500}
  - optimize:
      steps: 400
      losses: [{type: l1, weight: 0.8}, {type: dssim, weight: 0.2}]
      log_every: 50
      during:
        - densify:
            every: 50
            start: 20
            stop: 300
            rules: [{type: clone, gradient_above: 1.0e-4, size_below: 0.02}, {type: prune_faint, opacity_below: 0.005}]
        - reset_opacity: {every: 150, stop: 300, value: 0.1}
        - checkpoint: {every: 40}
  - evaluate
  - export
  - render
"""


class Sweep:
    """A sweep in its folder, run by the command."""

    def __init__(self, folder: Path, scene: Path, seeds: int, engine: str = "local") -> None:
        self.folder, self.out, self.store = folder, folder / "out", Store(folder / "store")
        self.file, self.on = folder / "sweep.yaml", folder / "on.yaml"
        execution = {"engine": engine, "store": str(self.store.root)}
        axes = {"scenes": [str(scene)], "seeds": list(range(seeds))}
        self.on.write_text(json.dumps(execution))
        self.file.write_text(f"name: sweep\nmatrix: {json.dumps(axes)}\n{PIPELINE}")

    def start(self) -> "subprocess.Popen[str]":
        """Start, or restart, the command."""
        words = ["run", str(self.file), "--out", str(self.out), "--resume", "--on", str(self.on)]
        return subprocess.Popen(
            [sys.executable, "-m", "clsplat", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # as in a terminal of its own
        )

    def saved(self) -> set[str]:
        """The current checkpoints of all attempts."""
        return {str(path) for path in self.store.root.glob("cells/*/attempts/*/checkpoints/step_*.npz")}

    def events(self, name: str) -> int:
        return [event["event"] for event in self.store.events()].count(name)

    def models(self) -> dict[str, str]:
        """The hash of the model of each cell, by its name."""
        return models(self.out)


def models(out: Path) -> dict[str, str]:
    actual = sorted(out.glob("*/point_cloud.ply"))
    return {path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in actual}


def hashes_without_store(sweep: Sweep, out: Path) -> dict[str, str]:
    """The hashes of the same cells, run one after the other without a store."""
    actual = load_experiment(str(sweep.file))
    assert actual is not None
    experiment.run_matrix(actual, RunState.read(out), None, "new")
    return models(out)


def runs_below(process: "subprocess.Popen[str]") -> "list[psutil.Process]":
    """The processes that train."""
    return [item for item in _below(process) if "--attended" in _words(item)]


def workers_below(process: "subprocess.Popen[str]") -> "list[psutil.Process]":
    """The processes of Dask's workers."""
    return [item for item in _below(process) if any("spawn_main" in word for word in _words(item))]


def _below(process: "subprocess.Popen[str]") -> "list[psutil.Process]":
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _words(process: "psutil.Process") -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def kill(processes: "list[psutil.Process]") -> int:
    """Kill them; return their number."""
    count = 0
    for process in processes:
        try:
            process.send_signal(signal.SIGKILL)
            count += 1
        except psutil.NoSuchProcess:
            pass
    return count


def until(holds: Callable[[], bool], seconds: float = 300) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come to that in time"
        time.sleep(0.1)
