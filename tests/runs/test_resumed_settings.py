"""Settings that may, and may not, change on resume."""

import json
import shutil
from types import SimpleNamespace

import pytest

from clsplat.core.errors import ConfigError
from clsplat.pipeline.file import RasterizerSettings
from clsplat.runs import opening
from clsplat.sweeps.experiment import Job
from clsplat.training import archive
from clsplat.training.status import read_status
from tests.support.runs import FEW, crafted, digest, steps_saved, train

pytestmark = pytest.mark.slow


def test_settings_without_effect_on_tables_may_change(killed_run, tiny_scene, few_steps, caplog):
    train(tiny_scene, killed_run, *FEW, "checkpoint.keep=1", "optimize.log_every=4", "render.folder=other", resume=True)
    assert digest(killed_run) == digest(few_steps)
    assert "bits are not" not in caplog.text
    assert "changes" not in json.loads((killed_run / "metrics.json").read_text())
    assert steps_saved(killed_run) == ["step_000012.npz"]


@pytest.mark.parametrize(
    "change", ["optimize.steps=14", "densify.stop=6", "optimize.losses.0.weight=0.7", "optimize.update=seen"]
)
def test_training_values_may_change(change, killed_run, tiny_scene, caplog):
    run = train(tiny_scene, killed_run, *FEW, change, resume=True)
    assert run.step == (14 if "steps" in change else 12)
    assert caplog.text.count("from here on, results differ from those without this change") == 1
    assert len(json.loads((killed_run / "metrics.json").read_text())["changes"]) == 1
    assert f"{change.split('=')[1]}" in (killed_run / "pipeline.yaml").read_text()


@pytest.mark.parametrize("change", ["seed=3", "init.count=70", "model.sh_degree=2", "optimize.losses=[l1]"])
def test_settings_that_shape_tables_may_not_change(change, killed_run, tiny_scene):
    with pytest.raises(ConfigError, match=r"was saved with other settings: .*restore the setting, or start over with"):
        train(tiny_scene, killed_run, *FEW, change, resume=True)


def test_fewer_steps_than_trained_are_refused(killed_run, tiny_scene, caplog):
    before = (killed_run / "pipeline.yaml").read_text()
    words = r"already at step 8; optimize.steps=6 would end before it; use 8 or more, or start over: `clsplat run`"
    with pytest.raises(ConfigError, match=words):
        train(tiny_scene, killed_run, *FEW, "optimize.steps=6", resume=True)
    assert "bits" not in caplog.text, "nothing goes on"
    assert (killed_run / "pipeline.yaml").read_text() == before


def test_finished_training_accepts_no_new_values(few_steps, tiny_scene, tmp_path):
    out = shutil.copytree(few_steps, tmp_path / "run")
    before = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    advice = f"to train longer, run `clsplat resume {out} --steps 24`"
    words = rf"no steps are left for the new setting: .*rates.quats was .*; {advice}"
    with pytest.raises(ConfigError, match=words):
        Job.resume(out, ["optimize.rates.quats=1e-5"]).run()
    assert {file: file.read_bytes() for file in before if file.name != "log.txt"} == {
        file: content for file, content in before.items() if file.name != "log.txt"
    }
    Job.resume(out, ["optimize.rates.quats=1e-5", "optimize.steps=14"]).run()
    assert len(json.loads((out / "metrics.json").read_text())["changes"]) == 2


def test_training_can_end_at_its_current_step(killed_run):
    Job.resume(killed_run, ["optimize.steps=8"]).run()
    assert read_status(killed_run)["state"] == "done"
    assert (killed_run / "point_cloud.ply").is_file()


def test_finished_stage_keeps_its_settings(killed_run, tiny_scene):
    crafted(
        killed_run / "checkpoints" / "step_000008.npz", lambda notes, arrays: notes.update(stage_index=2, stage_step=0)
    )
    with pytest.raises(ConfigError, match="was saved at step 8, after the stage that has changed"):
        train(tiny_scene, killed_run, *FEW, "optimize.steps=20", resume=True)


def test_run_stopped_after_its_last_stage_finishes(killed_run, tiny_scene, few_steps):
    last = len(archive.read(killed_run / "checkpoints" / "step_000008.npz")[0]["pipeline"]["stages"])
    shutil.copy(few_steps / "checkpoints" / "step_000012.npz", killed_run / "checkpoints")
    written = {"point_cloud.ply": digest(few_steps)}
    crafted(
        killed_run / "checkpoints" / "step_000012.npz",
        lambda notes, arrays: notes.update(stage_index=last, stage_step=0, model_hashes=written),
    )
    shutil.copy(few_steps / "point_cloud.ply", killed_run)
    before = (killed_run / "checkpoints" / "step_000012.npz").read_bytes()
    assert train(tiny_scene, killed_run, *FEW, resume=True).step == 12
    assert json.loads((killed_run / "status.json").read_text())["state"] == "done"
    assert (killed_run / "checkpoints" / "step_000012.npz").read_bytes() == before


def test_longer_training_reports_what_a_longer_plan_changes(few_steps, tiny_scene, tmp_path, caplog):
    """An edit that is due at the last step of a run skips no update, as it does between steps."""
    Job.resume(few_steps, steps=14)
    assert "'densify' was due at step 12, the last one, so the result differs from a single longer run" in caplog.text
    out = tmp_path / "run"
    train(tiny_scene, out, *FEW, "densify.stop=12")
    caplog.clear()
    Job.resume(out, steps=14)
    assert not caplog.records


@pytest.mark.parametrize(
    ("schedule", "earlier", "expected"),
    [
        ("auto", "{}, simt16 schedule", ["auto", "simt16"]),
        ("auto", "{}, wide schedule", ["auto"]),
        ("auto", "another device, simt16 schedule", ["auto"]),
        ("auto", None, ["auto"]),
        ("simt", "{}, simt16 schedule", ["simt"]),
    ],
)
def test_resumed_run_keeps_its_schedule(monkeypatch, info, schedule, earlier, expected):
    opened = []

    def open_verified(device, schedule, sort):
        opened.append(schedule)
        return SimpleNamespace(info=info, label=f"{info.label}, {'wide' if schedule == 'auto' else schedule} schedule")

    monkeypatch.setattr(opening, "open_verified", open_verified)
    rasterizer = RasterizerSettings(schedule=schedule)
    opening._open_device(rasterizer, None, earlier.format(info.label) if earlier else None)
    assert opened == expected
