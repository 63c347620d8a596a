"""A failing run saves its last complete state, and resumes to the same bits."""

import errno
import json
import re

import pytest

from clsplat.core.errors import DataError, DeviceError, InternalError, OutputError, as_clsplat_error
from clsplat.density import control
from clsplat.density.statistics import SplatStats
from clsplat.photos.photographs import Photographs
from clsplat.render.rasterizer import Rasterizer
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.report import HtmlReport
from clsplat.sweeps.experiment import Job
from clsplat.training import checkpoint
from clsplat.training.status import StatusFile
from tests.support.runs import FEW, digest, records, steps_saved, train

pytestmark = pytest.mark.slow


def fail_at(step: int, monkeypatch: pytest.MonkeyPatch, where: str) -> type[Exception]:
    """Make a run fail in a step, at a given point of it."""
    counts = {"photograph": 0, "frame": 0}
    get, start_forward, is_complete = Photographs.get, Rasterizer.start_forward, Rasterizer.is_complete

    def photograph(photographs, view):
        counts["photograph"] += 1
        if counts["photograph"] == step:
            raise DataError("the photo is damaged")
        return get(photographs, view)

    def kernel(rasterizer, *arguments, **others):
        if counts["frame"] == step - 1:
            raise DeviceError("the device is lost for a moment")
        return start_forward(rasterizer, *arguments, **others)

    def count_frames(rasterizer, frame):
        fits = is_complete(rasterizer, frame)
        counts["frame"] += fits
        return fits

    if where == "photograph":
        monkeypatch.setattr(Photographs, "get", photograph)
        return DataError
    monkeypatch.setattr(Rasterizer, "start_forward", kernel)
    monkeypatch.setattr(Rasterizer, "is_complete", count_frames)
    return DeviceError


@pytest.mark.parametrize(("where", "step"), [("photograph", 6), ("kernel", 5)])  # 5: after the edit of step 4
def test_failure_within_a_step_saves_the_previous_step(
    where, step, tiny_scene, tmp_path, monkeypatch, few_steps, caplog
):
    raised = fail_at(step, monkeypatch, where)
    with pytest.raises(raised):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert steps_saved(tmp_path)[-1] == f"step_00000{step - 1}.npz"
    assert f"the state of step {step - 1} is saved in {tmp_path}" in caplog.text
    status = json.loads((tmp_path / "status.json").read_text())
    assert (status["state"], status["step"], status["checkpoint"]) == ("failed", step - 1, steps_saved(tmp_path)[-1])
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert digest(tmp_path) == digest(few_steps)
    assert records(tmp_path) == records(few_steps)


@pytest.mark.parametrize(
    ("error", "call"),
    [
        *((DataError("cut"), 1), (MemoryError(), 2), (OSError(errno.EIO, "bad disk"), 1)),
        *((SystemExit(3), 2), (GeneratorExit(), 1), (StopIteration("out"), 2)),
    ],
)
def test_failing_evaluation_loses_nothing(error, call, tiny_scene, tmp_path, monkeypatch, few_steps):
    evaluate, calls = Evaluate.run, []

    def run(stage, run):
        calls.append(run.step)
        if len(calls) == 2 * call - 1:  # after step 6, and at the end
            raise error
        evaluate(stage, run)

    monkeypatch.setattr(Evaluate, "run", run)
    with pytest.raises(type(as_clsplat_error(error)), match=re.escape(str(as_clsplat_error(error)))):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert steps_saved(tmp_path)[-1] == ("step_000006.npz" if call == 1 else "step_000012.npz")
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert digest(tmp_path) == digest(few_steps)
    assert records(tmp_path) == records(few_steps)


def test_failure_is_recorded_once(tiny_scene, tmp_path, monkeypatch):
    end, states = StatusFile.end, []

    def recorded(status, state, *more):
        states.append(state)
        end(status, state, *more)

    def fail(stage, run):
        raise ZeroDivisionError

    monkeypatch.setattr(StatusFile, "end", recorded)
    monkeypatch.setattr(HtmlReport, "run", fail)
    with pytest.raises(InternalError, match="ZeroDivisionError"):
        Job.open("smoke", tiny_scene, tmp_path, FEW).run()
    assert states == ["failed"]


def test_failed_report_is_written_on_resume(tiny_scene, tmp_path, monkeypatch, few_steps):
    def fail(stage, run):
        raise ZeroDivisionError

    monkeypatch.setattr(HtmlReport, "run", fail)
    with pytest.raises(Exception, match="ZeroDivisionError"):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert not (tmp_path / "report.html").exists()
    assert train(tiny_scene, tmp_path, *FEW, resume=True).step == 12
    assert (tmp_path / "report.html").exists()
    assert digest(tmp_path) == digest(few_steps)


@pytest.mark.parametrize("place", ["SplatStats.add", "density edit"])
def test_incomplete_step_is_not_saved(place, tiny_scene, tmp_path, monkeypatch, few_steps, caplog):
    of, name, at = (SplatStats, "add", 7) if place == "SplatStats.add" else (control, "apply_edit", 2)
    before, calls = getattr(of, name), []

    def fail(*arguments):
        calls.append(1)
        if len(calls) == at:
            raise MemoryError
        return before(*arguments)

    monkeypatch.setattr(of, name, fail)
    with pytest.raises(Exception, match="out of memory"):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    newest = steps_saved(tmp_path)[-1]
    assert newest in ("step_000004.npz", "step_000008.npz")
    assert f"the failed step was incomplete; the last good state is {tmp_path / 'checkpoints' / newest}" in caplog.text
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert digest(tmp_path) == digest(few_steps)
    assert records(tmp_path) == records(few_steps)


def test_failed_save_does_not_hide_the_first_error(tiny_scene, tmp_path, monkeypatch, caplog):
    fail_at(6, monkeypatch, "photograph")
    save = checkpoint.save

    def full(run, keep=None):
        if run.step == 5:
            raise OutputError("the disk is full")
        return save(run, keep)

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(DataError, match="the photo is damaged"):
        train(tiny_scene, tmp_path, *FEW)
    assert "could not be saved (the disk is full); the last good state is " in caplog.text
