"""A signal in a stage other than training: the state is saved, and the run resumes to the same bits."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clsplat.core.errors import Interrupted
from clsplat.metrics import views
from clsplat.stages import densify, render, report
from clsplat.stages.init import Init
from clsplat.sweeps.experiment import Job
from clsplat.training.status import read_status
from tests.support.runs import digest

pytestmark = pytest.mark.slow

PIPELINE = """
name: edited
stages:
  - init: {source: random, count: 300}
  - optimize:
      steps: 6
      log_every: 2
      losses: [l1]
      during: [{evaluate: {every: 4}}]
  - densify: {rules: [{type: prune_unimportant, share: 0.5}]}  # twice would be another model
  - evaluate: {split: train}
  - export
  - render
  - report
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("signals") / "edited.yaml"
    file.write_text(PIPELINE)
    return str(file)


@pytest.fixture(scope="module")
def uninterrupted(pipeline: str, tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("signals") / "run"
    Job.open(pipeline, tiny_scene, out).run()
    return out


def signalled(function: Callable[..., Any], call: int, times: int = 1) -> Callable[..., Any]:
    """The function; before one of its calls this process gets SIGTERM."""
    calls: list[int] = []

    def called(*arguments: Any, **named: Any) -> Any:
        calls.append(1)
        for _ in range(times if len(calls) == call else 0):
            os.kill(os.getpid(), signal.SIGTERM)
        return function(*arguments, **named)

    return called


PLACES = {  # what is called for the n-th time when the signal comes -> the message
    "an evaluation in training": (views, "render_floats", 1, "stopped at step 4, saved in "),
    "a stage that edits": (densify, "densify", 1, "stopped in densify, saved in "),
    "an evaluation": (views, "render_floats", 4, "stopped in evaluate, saved in "),
    "renders": (render, "render_view", 1, "stopped in render, saved in "),
    "the report": (report, "render_view", 1, "stopped in report, saved in "),
}


@pytest.mark.parametrize("place", PLACES)
def test_long_stage_ends_early_with_saved_state_and_is_repeated(
    place, pipeline, uninterrupted, tiny_scene, tmp_path, monkeypatch
):
    module, name, call, message = PLACES[place]
    with monkeypatch.context() as patch:
        patch.setattr(module, name, signalled(getattr(module, name), call))
        with pytest.raises(Interrupted, match=message) as stopped:
            Job.open(pipeline, tiny_scene, tmp_path).run()
    assert str(stopped.value).endswith(f"; `clsplat resume {tmp_path}` continues from it")
    assert read_status(tmp_path)["state"] == "interrupted"
    assert list((tmp_path / "checkpoints").glob("*.npz"))
    Job.resume(tmp_path).run()
    assert read_status(tmp_path)["state"] == "done"
    assert digest(tmp_path) == digest(uninterrupted)
    for file in (uninterrupted / "renders").rglob("*.png"):
        assert (tmp_path / file.relative_to(uninterrupted)).read_bytes() == file.read_bytes()


def test_second_signal_stops_at_once(pipeline, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(render, "render_view", signalled(render.render_view, 1, times=2))
    words = f"stopped at once, and no checkpoint was saved; `clsplat resume {tmp_path}` starts it over"
    with pytest.raises(Interrupted, match=re.escape(words)):
        Job.open(pipeline, tiny_scene, tmp_path).run()
    assert read_status(tmp_path)["state"] == "interrupted"
    assert not list((tmp_path / "renders").rglob("*.png"))


def test_first_signal_without_a_model_stops_at_once(pipeline, tiny_scene, tmp_path, monkeypatch):
    run = Init.run
    monkeypatch.setattr(Init, "run", lambda stage, state: signalled(run, 1)(stage, state))
    with pytest.raises(Interrupted, match="stopped at once"):
        Job.open(pipeline, tiny_scene, tmp_path).run()
    assert read_status(tmp_path)["state"] == "interrupted"
    assert not (tmp_path / "checkpoints").exists()


AFTER = """
import os, signal
from clsplat.prepare.database import require_pycolmap

def handler(number, frame):
    raise SystemExit("handled")

signal.signal(signal.SIGTERM, handler)
require_pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
"""
WITHIN = """
import signal, sys
from clsplat.prepare.database import require_pycolmap

class Finder:
    def find_spec(name, path, target=None):
        if name == "pycolmap":
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder)
try:
    require_pycolmap()
except KeyboardInterrupt:
    raise SystemExit("handled" if "pycolmap._core" in sys.modules else "in the middle")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGTERM ends a process at once there")
@pytest.mark.parametrize("script", [AFTER, WITHIN], ids=["after its import", "within its import"])
def test_pycolmap_does_not_take_signals(script):
    """Its import has SIGTERM end the process with a dump, and turns a KeyboardInterrupt into a defect."""
    pytest.importorskip("pycolmap")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "handled\n")
