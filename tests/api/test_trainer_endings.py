"""How a trainer ends: by an error, an interrupt, `close()`, or garbage collection."""

import gc
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ClsplatError, ConfigError, NumericError
from clsplat.density.statistics import SplatStats
from clsplat.photos.photographs import Photographs
from clsplat.stages.schedule import RaiseSh
from tests.support.models import equal

pytestmark = pytest.mark.slow


def parse_status(out: Path) -> dict:
    return json.loads((out / "status.json").read_text())


def test_trainer_closed_or_released_early_was_interrupted(tiny_scene, tmp_path):
    trainer = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 4}, out=tmp_path / "run")
    trainer.run(2)
    trainer.checkpoint()
    assert parse_status(tmp_path / "run")["state"] == "running"
    trainer.close()
    status = parse_status(tmp_path / "run")
    assert (status["state"], status["exit_code"], status["step"]) == ("interrupted", 130, 2)
    assert status["message"] == "the trainer was closed before its last step"
    assert clsplat.status(tmp_path / "run")["state"] == "interrupted"
    again = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 4}, out=tmp_path / "run", start="resume")
    assert again.step().step == 3
    del again
    gc.collect()
    assert parse_status(tmp_path / "run")["state"] == "interrupted"
    last = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 4}, out=tmp_path / "run", start="resume")
    assert last.run().step == 4
    last.close()
    assert parse_status(tmp_path / "run")["state"] == "done"
    anew = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 4}, out=tmp_path / "run", start="restart")
    assert not list((tmp_path / "run" / "checkpoints").iterdir())
    shutil.rmtree(tmp_path / "run")
    anew.close()
    assert not (tmp_path / "run").exists(), "a folder that was removed stays so"


def test_trainer_overwrites_no_foreign_file(tiny_scene, tmp_path):
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(ConfigError, match=r"report.html: exists, and is not from a run"):
        clsplat.Trainer(tiny_scene, "smoke", out=tmp_path)
    with pytest.raises(ConfigError, match="is, or is inside, the folder of the photos"):
        clsplat.Trainer(tiny_scene, "smoke", out=tiny_scene)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_trainer_has_ended_after_an_error_inside_a_step(tiny_scene):
    trainer = clsplat.Trainer(tiny_scene, "smoke")
    trainer.add_loss(lambda image, photograph: (0.0, np.zeros(3)))
    with pytest.raises(
        ValueError, match=r"the loss returned a gradient of shape \(3,\); expected that of the image, \(40, 40, 3\)"
    ):
        trainer.run(2)
    with pytest.raises(ClsplatError, match="ended with an error; create a new one, with start='resume'"):
        trainer.run(2)


@pytest.mark.parametrize("broken", ["value", "derivative"])
def test_nonfinite_loss_stops_before_the_model_changes(tiny_scene, broken):
    def odd(image, photograph):
        factor = np.float32(np.nan)
        return (factor, image) if broken == "value" else (0.0, image * factor)

    trainer = clsplat.Trainer(tiny_scene, "smoke")
    before = trainer.model
    trainer.add_loss(odd)
    with pytest.raises(NumericError, match=r"^step 1: the loss 'odd' returned values that are not finite; look"):
        trainer.run(3)
    assert equal(trainer.model, before)


def test_step_error_is_raised_and_in_the_status(tiny_scene, tmp_path):
    def broken(image, photograph):
        raise RuntimeError("no such teapot")

    trainer = clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "run")
    trainer.run(2)
    trainer.add_loss(broken)
    with pytest.raises(RuntimeError, match="no such teapot"):
        trainer.run()
    status = clsplat.status(tmp_path / "run")
    assert (status["state"], status["step"], status["checkpoint"]) == ("failed", 2, "step_000002.npz")
    assert "no such teapot" in status["message"]


def test_failed_edit_between_steps_prevents_saving(tiny_scene, tmp_path, monkeypatch):
    two = tmp_path / "two.yaml"
    part = "  - optimize: {steps: 2, losses: [l1]}\n"
    two.write_text(f"name: two\nstages:\n  - init\n{part}  - raise_sh\n{part}")

    def fail(stage, run):
        raise RuntimeError("no such teapot")

    monkeypatch.setattr(RaiseSh, "run", fail)
    trainer = clsplat.Trainer(tiny_scene, two, out=tmp_path / "run")
    with pytest.raises(RuntimeError, match="no such teapot"):
        trainer.run()
    with pytest.raises(ClsplatError, match="step 2 is incomplete"):
        trainer.checkpoint()
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_error_before_the_first_step_is_in_the_status(tiny_scene, tmp_path, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("no such teapot")

    monkeypatch.setattr("clsplat.api.trainer.run_until_training", fail)
    with pytest.raises(RuntimeError, match="no such teapot"):
        clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "run")
    assert clsplat.status(tmp_path / "run")["state"] == "failed"


def test_training_can_continue_after_an_interrupt(tiny_scene):
    trainer, whole = (clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 20}) for _ in range(2))
    pressed = []

    def press(image, photograph):
        if not pressed:
            pressed.append(os.kill(os.getpid(), signal.SIGINT))
        return 0.0, np.zeros_like(image)

    whole.add_loss(lambda image, photograph: (0.0, np.zeros_like(image)))
    trainer.add_loss(press)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert repr(trainer).endswith("step 1)")
    assert trainer.run().step == whole.run().step == 20
    assert equal(trainer.model, whole.model)


def test_second_interrupt_saves_the_last_whole_step_or_none(tiny_scene, tmp_path, monkeypatch):
    few = {"optimize.steps": 4}
    for place, step in ((Photographs, 2), (SplatStats, 3)):
        out = tmp_path / place.__name__
        trainer = clsplat.Trainer(tiny_scene, "smoke", set=few, out=out)
        trainer.run(2)
        with monkeypatch.context() as patch:
            patch.setattr(place, "get" if place is Photographs else "add", _interrupt)
            with pytest.raises(KeyboardInterrupt):
                trainer.step()
        if place is SplatStats:  # in the middle of the update
            with pytest.raises(ClsplatError, match="step 3 is incomplete, so it is not saved"):
                trainer.checkpoint()
            assert not (out / "checkpoints").exists()
            continue
        assert trainer.checkpoint().name == f"step_00000{step}.npz"
        again = clsplat.Trainer(tiny_scene, "smoke", set=few, out=out, start="resume")
        again.run()
        whole = clsplat.Trainer(tiny_scene, "smoke", set=few)
        whole.run()
        assert equal(again.model, whole.model)


def _interrupt(*arguments):
    raise KeyboardInterrupt
