"""Training that keeps the best model on validation views, and reports about it."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from clsplat import Trainer
from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.splats import PARAMETERS
from clsplat.formats.table import read as read_ply
from clsplat.pipeline.loading import load
from clsplat.runs.runner import with_refit_steps
from clsplat.runs.status import summarize_run
from clsplat.stages.report import NAMES, is_overfit, overfitting_note
from clsplat.sweeps.experiment import Job
from clsplat.training import best_model, checkpoint
from clsplat.training.archive import split
from clsplat.training.best_model import Best, Scores
from tests.support.runs import digest, train

pytestmark = pytest.mark.slow

BEST, STEPS = 8, 20  # step after which a rate spoils the model, and of all
WORSE = f"""
name: worse
scene: {{validation: auto}}
stages:
  - init: {{source: auto, count: 200, opacity: 0.3}}
  - optimize:
      steps: {STEPS}
      keep: best
      rates: {{means: [[{BEST}, 1.0e-3], [{BEST + 1}, 0.3]], log_scales: 0.02, logit_opacity: 0.05, sh_base: 0.02}}
      losses: [l1]
      log_every: 4
      during:
        - densify:
            every: 3
            start: {BEST}
            stop: 19
            rules: [{{type: clone, gradient_above: 1.0e-9, size_below: 1}}]
        - evaluate: {{every: 4, split: validation}}
        - evaluate: {{every: 4, split: test}}
        - checkpoint: {{every: 2, keep: 99}}
  - evaluate: {{split: test}}
  - export: {{file: point_cloud.ply}}
  - report
"""
PATIENT = ("optimize.patience=2",)
REFIT = (*PATIENT, "optimize.refit=true")
TIMES = {"ms", "stages", "train_seconds", "cpu_seconds", "device_memory", "seconds", "scene"}


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("pipeline") / "worse.yaml"
    file.write_text(WORSE)
    return str(file)


@pytest.fixture(scope="module")
def best_run(tiny_scene, tmp_path_factory, pipeline) -> Path:
    return train(tiny_scene, tmp_path_factory.mktemp("best") / "run", pipeline=pipeline).out


@pytest.fixture(scope="module")
def refit(tiny_scene, tmp_path_factory, pipeline) -> Path:
    return train(tiny_scene, tmp_path_factory.mktemp("refit") / "run", *REFIT, pipeline=pipeline).out


def metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def lines(out: Path, name: str = "metrics.jsonl") -> list[dict]:
    actual = [json.loads(line) for line in (out / name).read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in TIMES} for line in actual]


def psnr_of(out: Path, split: str, name: str = "metrics.jsonl") -> dict[int, float]:
    actual = [line for line in lines(out, name) if line["kind"] == "evaluate" and line["split"] == split]
    return {line["step"]: line["psnr"] for line in actual}


def equal_ends(one: Path, other: Path) -> None:
    assert digest(one) == digest(other)
    first, second = ({k: v for k, v in metrics(out).items() if k not in TIMES} for out in (one, other))
    assert first == second
    assert lines(one) == lines(other)


# ---- the best model


def test_training_leaves_the_best_model_on_validation_views(best_run):
    measured = psnr_of(best_run, "validation")
    assert sorted(measured) == list(range(4, STEPS + 1, 4))
    assert max(measured, key=measured.__getitem__) == BEST
    actual = read_ply(best_run / "point_cloud.ply").parameters
    _, expected = checkpoint.load(best_run / "checkpoints" / f"step_{BEST:06d}.npz")
    for name in PARAMETERS:
        np.testing.assert_array_equal(actual[name], expected[f"gaussians/{name}"], err_msg=name)
    assert len(actual["means"]) < len(
        checkpoint.load(best_run / "checkpoints" / f"step_{STEPS:06d}.npz")[1]["gaussians/means"]
    )


def test_metrics_are_those_of_the_best_model(best_run):
    actual = metrics(best_run)
    assert actual["kept"]["step"] == BEST
    assert actual["kept"]["ended"] == actual["steps"] == STEPS
    assert actual["kept"]["evaluations"] == 5
    assert actual["validation"]["1"]["psnr"] == actual["kept"]["validation"] == psnr_of(best_run, "validation")[BEST]
    assert actual["validation"]["1"]["views"] == 2
    assert actual["train"]["1"]["psnr"] == actual["kept"]["train"] == psnr_of(best_run, "train")[BEST]
    assert actual["train"]["1"]["views"] == 6
    assert actual["test"]["1"]["psnr"] == psnr_of(best_run, "test")[BEST]
    assert f"best     model of step {BEST}" in "\n".join(summarize_run(best_run))
    assert summarize_run(best_run)[-1].endswith("in a browser"), "more steps were no better"


def test_report_shows_three_splits_and_the_best_step(best_run):
    page = (best_run / "report.html").read_text()
    for text in (*NAMES.values(), f"the model of step {BEST} is the best", "That model is kept"):
        assert text in page


@pytest.mark.parametrize("last", [2, BEST, STEPS])
def test_run_resumed_from_any_checkpoint_gives_the_same(tiny_scene, tmp_path, pipeline, best_run, last):
    out = shutil.copytree(best_run, tmp_path / "run")
    for path in checkpoint.list_files(out):
        if int(path.stem.removeprefix("step_")) > last:
            path.unlink()
    for name in ("point_cloud.ply", "metrics.json", "report.html", "checksums.json"):
        (out / name).unlink()
    train(tiny_scene, out, pipeline=pipeline, resume=True)
    equal_ends(out, best_run)


def test_patience_ends_a_training(tiny_scene, tmp_path, pipeline, best_run):
    run = train(tiny_scene, tmp_path / "run", *PATIENT, pipeline=pipeline)
    assert run.step == BEST + 2 * 4
    assert metrics(run.out)["kept"]["ended"] == run.step
    assert digest(run.out) == digest(best_run)
    assert checkpoint.list_files(run.out)[-1].name == f"step_{run.step:06d}.npz", "of the end, to train longer"
    longer = train(tiny_scene, run.out, "optimize.patience=99", pipeline=pipeline, resume=True)
    assert longer.step == STEPS
    assert digest(run.out) == digest(best_run)


def growth_by_step(out: Path) -> dict[int, bool]:
    """By step, whether an edit has added Gaussians."""
    return {line["step"]: line["after"] > line["before"] for line in lines(out) if line["kind"] == "densify"}


def test_growth_ends_without_validation_improvement(tiny_scene, tmp_path, pipeline, best_run):
    assert growth_by_step(best_run) == {9: True, 12: True, 15: True, 18: True}
    out = train(tiny_scene, tmp_path / "1", "densify.patience=1", pipeline=pipeline).out
    assert growth_by_step(out) == {9: True, 12: False, 15: False, 18: False}
    assert metrics(out)["kept"]["growth_ended"] == 12
    assert digest(out) == digest(best_run), "of a step before"
    until = train(tiny_scene, tmp_path / "until", "densify.grow_until=12", pipeline=pipeline).out
    assert growth_by_step(until) == growth_by_step(out)
    again = shutil.copytree(tmp_path / "1", tmp_path / "again")
    for path in checkpoint.list_files(again):
        if int(path.stem.removeprefix("step_")) > 14:
            path.unlink()
    for name in ("point_cloud.ply", "metrics.json", "report.html", "checksums.json"):
        (again / name).unlink()
    train(tiny_scene, again, "densify.patience=1", pipeline=pipeline, resume=True)
    equal_ends(again, tmp_path / "1")


def test_refit_ends_growth_at_the_same_step(tiny_scene, pipeline):
    pipeline = load(pipeline, ["densify.patience=1", "optimize.refit=true"])
    result = Scores(step=30, train=20, validation=20)
    best_run = Best(
        measured=result,
        degree=0,
        metrics={},
        evaluations=9,
        since_best=2,
        first_overfit=None,
        last=result,
        growth_ended=20,
    )
    run = SimpleNamespace(best=best_run.model_copy(update={"refit": "begun"}), is_refit=True)
    training = with_refit_steps(pipeline, run).settings.training
    density = next(stage for stage in training.during if stage.stage == "densify")
    assert (training.steps, density.patience, density.grow_until) == (30, None, 20)


def test_training_continues_from_the_last_step(tiny_scene, tmp_path, pipeline, best_run):
    longer = train(tiny_scene, tmp_path / "longer", "optimize.steps=24", pipeline=pipeline)
    out = shutil.copytree(best_run, tmp_path / "run")
    train(tiny_scene, out, "optimize.steps=24", pipeline=pipeline, resume=True)
    assert digest(out) == digest(longer.out)
    assert sorted(psnr_of(out, "validation")) == list(range(4, 25, 4))


@pytest.mark.parametrize(
    "own", ["{every: 50, split: validation, stop: 40}", "{every: 60, split: validation, start: 60}"]
)
def test_measurement_never_due_is_refused_before_the_first_step(tiny_scene, tmp_path, pipeline, own):
    during = f"optimize.during=[evaluate: {own}]"
    with pytest.raises(ConfigError, match="needs an evaluation of the validation views before the end"):
        train(tiny_scene, tmp_path / "run", during, pipeline=pipeline)


def test_measurements_of_a_later_training_count_from_its_start(tmp_path):
    during = "during: [{evaluate: {every: 8, split: validation}}]"
    stages = "stages:\n  - {}\n  - init\n  - optimize: {{steps: {}, losses: [l1], keep: best, {}}}\n"
    for first in ("train_field: {steps: 4, during: []}", "init\n  - optimize: {steps: 4, losses: [l1]}"):
        (tmp_path / "x.yaml").write_text("name: x\nscene: {validation: auto}\n" + stages.format(first, 4, during))
        assert load(str(tmp_path / "x.yaml")).settings.training
        (tmp_path / "x.yaml").write_text("name: x\nscene: {validation: auto}\n" + stages.format(first, 3, during))
        with pytest.raises(ConfigError, match="needs an evaluation of the validation views before the end"):
            load(str(tmp_path / "x.yaml"))


def test_measurement_at_another_size_is_not_used_to_choose(tiny_scene, tmp_path, pipeline):
    during = "optimize.during=[evaluate: {every: 4, split: validation, downscales: [2]}]"
    run = train(tiny_scene, tmp_path / "run", during, pipeline=pipeline)
    assert run.best.evaluations + run.best.since_best == 1, "after the last step"


def test_training_ended_by_patience_has_a_final_checkpoint(tiny_scene, tmp_path, pipeline):
    """Also where `during` names the checkpoint first."""
    during = "optimize.during=[checkpoint: {every: 20}, evaluate: {every: 4, split: validation}]"
    run = train(tiny_scene, tmp_path / "run", during, *PATIENT, pipeline=pipeline)
    assert run.step < STEPS
    assert checkpoint.list_files(tmp_path / "run")[-1].name == f"step_{run.step:06d}.npz"


def test_twenty_measurements_are_added_by_default(pipeline):
    training = load("splat_7k", ["scene.validation=auto", "optimize.keep=best"]).settings.training
    train_, validation, *others = training.inner
    assert others == training.during
    assert (validation.split, validation.every) == ("validation", 350)
    assert (train_.split, train_.every, train_.max_views) == ("train", 350, 8)
    assert load("splat_7k").settings.training.inner == training.during


# ---- training again on all


def test_refit_has_the_bits_of_a_run_without_validation(tiny_scene, tmp_path, pipeline, refit, best_run):
    plain = ("scene.validation=0", "optimize.keep=last", f"optimize.steps={BEST}")
    expected = train(tiny_scene, tmp_path / "plain", *plain, pipeline=pipeline).out
    assert digest(refit) == digest(expected)
    assert digest(refit) != digest(best_run)
    actual = metrics(refit)
    assert actual["steps"] == actual["kept"]["step"] == BEST
    assert actual["kept"]["refit"] is True
    assert "validation" not in actual, "it has trained on those views"
    own = [line for line in lines(refit) if line.get("split") != "validation"]
    assert own == lines(expected), "metrics.jsonl is of the model that is left"
    assert psnr_of(refit, "validation", "trial.jsonl") == {
        step: psnr for step, psnr in psnr_of(best_run, "validation").items() if step <= BEST + 2 * 4
    }
    assert f"Training is then repeated on all training photos for {BEST} steps" in (refit / "report.html").read_text()


@pytest.mark.parametrize("names", ["step_000016", "refit_000002", "refit_000008"])
def test_refit_resumed_from_any_checkpoint_gives_the_same(tiny_scene, tmp_path, pipeline, refit, names):
    out = shutil.copytree(refit, tmp_path / "run")
    files = checkpoint.list_files(out)
    assert [file.stem for file in files] == [f"step_{s:06d}" for s in range(2, 17, 2)] + [
        f"refit_{s:06d}" for s in range(2, BEST + 1, 2)
    ]
    last = next(i for i, file in enumerate(files) if file.stem == names)
    for path in files[last + 1 :]:
        path.unlink()
    for name in ("point_cloud.ply", "metrics.json", "report.html", "checksums.json"):
        (out / name).unlink()
    train(tiny_scene, out, *REFIT, pipeline=pipeline, resume=True)
    equal_ends(out, refit)
    assert lines(out, "trial.jsonl") == lines(refit, "trial.jsonl")


def test_refit_does_not_resume_with_other_steps(tiny_scene, tmp_path, pipeline, refit):
    out = shutil.copytree(refit, tmp_path / "run")
    with pytest.raises(ConfigError, match="is from a refit, whose steps were chosen by validation"):
        train(tiny_scene, out, *REFIT, "optimize.steps=80", pipeline=pipeline, resume=True)


@pytest.mark.parametrize("settings", [(), REFIT], ids=["best", "refit"])
def test_trainer_gives_the_bits_of_a_run(tiny_scene, tmp_path, pipeline, settings, best_run, refit):
    given = {"optimize.patience": 2, "optimize.refit": True}
    trainer = Trainer(tiny_scene, pipeline, set={key: given[key] for key in [*given][: len(settings)]})
    steps = [report.step for report in trainer.steps()]
    assert steps == ([*range(1, 17), *range(1, BEST + 1)] if settings else [*range(1, STEPS + 1)])
    trainer.model.save(tmp_path / "model.ply")
    expected = refit if settings == REFIT else best_run
    assert (tmp_path / "model.ply").read_bytes() == (expected / "point_cloud.ply").read_bytes()


# ---- what is not looked at


@pytest.mark.parametrize("split", ["validation", "test"])
def test_validation_images_do_not_change_the_model(tiny_scene, tmp_path, pipeline, split, best_run):
    """Those for validation choose the step, and nothing else; those for testing nothing."""
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    settings = load(pipeline, [f"scene.path='{scene}'"]).settings.scene
    for view in settings.read(scene)[0].split(split):
        cv2.imwrite(str(view.image_path), 0 * cv2.imread(str(view.image_path)))
    run = train(scene, tmp_path / "run", pipeline=pipeline)
    last = [checkpoint.load(out / "checkpoints" / f"step_{STEPS:06d}.npz")[1] for out in (run.out, best_run)]
    for name in PARAMETERS:
        np.testing.assert_array_equal(last[0][f"gaussians/{name}"], last[1][f"gaussians/{name}"])
    assert psnr_of(run.out, split) != psnr_of(best_run, split)
    assert (digest(run.out) == digest(best_run)) == (split == "test")


# ---- what is refused


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        (["scene.validation=0"], "set `scene.validation: auto`"),
        (["optimize.keep=last", "optimize.patience=3"], "'patience' needs 'keep: best'; set both or neither"),
        (["optimize.keep=last", "optimize.refit=true"], "'refit' needs 'keep: best'"),
    ],
)
def test_best_model_without_validation_is_refused(pipeline, settings, fault):
    with pytest.raises(ConfigError, match=fault):
        load(pipeline, settings)


def test_other_models_at_the_end_are_refused(tmp_path):
    head = "name: x\nscene: {validation: auto}\nstages:\n  - init: {}\n"
    first = "  - optimize: {steps: 9, keep: best, losses: [l1], during: [{average: {every: 2}}]}\n"
    two = "  - optimize: {steps: 9, losses: [l1]}\n  - optimize: {steps: 9, keep: best, refit: true, losses: [l1]}\n"
    for stages, fault in ((first, "not an average"), (two, "expected a single stage that trains, got 2")):
        (tmp_path / "x.yaml").write_text(head + stages)
        with pytest.raises(ConfigError, match=fault):
            load(str(tmp_path / "x.yaml"))


@pytest.mark.parametrize(("steps", "every"), [(7000, 350), (2019, 100), (730, 104), (350, 116), (199, 199), (12, 12)])
def test_training_is_measured_near_its_end(pipeline, steps, every):
    """A refit of a short one would be up to 99 steps shorter than it."""
    training = load(pipeline).settings.training.model_copy(update={"steps": steps, "keep": "best"})
    assert {measurement.every for measurement in training.measurements([])} == {every}
    assert steps % every < 20


def test_minutes_and_refit_are_incompatible(tiny_scene, tmp_path, pipeline):
    job = Job.open(pipeline, tiny_scene, tmp_path / "run", REFIT)
    with pytest.raises(ConfigError, match=r"a refit trains twice, .*; add --set optimize\.refit=false"):
        job.run(minutes=5)


def test_trainer_needs_a_scene_with_validation_views(tiny_scene, pipeline):
    import clsplat

    trainer = Trainer(clsplat.read_scene(tiny_scene), pipeline)
    with pytest.raises(ConfigError, match="set `scene"):
        trainer.step()


NOW = Scores(step=8, train=30.0, validation=20.0)
FOUND = Best(measured=NOW, degree=0, metrics={}, evaluations=1, since_best=0, first_overfit=None, last=NOW)


def test_end_of_growth_restarts_the_patience(pipeline):
    during = load(pipeline, ["densify.patience=2"]).settings.training.during
    density = next(stage for stage in during if stage.stage == "densify")
    run = SimpleNamespace(step=12, is_refit=False, best=FOUND.model_copy(update={"since_best": 2}))
    assert density._has_growth_ended(run)
    assert (run.best.growth_ended, run.best.since_best) == (12, 0)


def test_checkpoint_without_its_best_model_is_damaged(best_run):
    state, tables = checkpoint.load(best_run / "checkpoints" / "step_000014.npz")
    own, _ = split(tables, best_model.FOLDER)
    assert state.best is not None
    assert state.best.measured.step == BEST
    best_model.check(state.best, own)
    for wrong in (
        {name: table for name, table in own.items() if name != "means"},
        {**own, "means": own["means"][1:]},
        {**own, "quats": own["quats"] * np.float32(np.nan)},
    ):
        with pytest.raises(DataError, match="best model"):
            best_model.check(state.best, wrong)
    with pytest.raises(DataError, match="no record of one"):
        best_model.check(None, own)
    assert split(checkpoint.load(best_run / "checkpoints" / "step_000002.npz")[1], best_model.FOLDER)[0] == {}


# ---- in words


@pytest.mark.parametrize(
    ("train_", "validation", "expected"),
    [
        (26.0, 20.0, "At step 8 the model has 26.0 dB on training views and 20.0 dB on validation views."),
        (26.1, 20.0, "20.0 dB on validation views, more than 6 dB apart: the model overfits."),
    ],
)
def test_six_decibels_apart_is_overfit(train_, validation, expected):
    assert expected in Scores(step=8, train=train_, validation=validation).text("validation")


def test_run_without_validation_reports_overfitting(tiny_scene, tmp_path, pipeline):
    plain = ("scene.validation=0", "optimize.keep=last", "optimize.steps=8")
    run = train(tiny_scene, tmp_path / "run", *plain, pipeline=pipeline)
    assert overfitting_note(run) == ""
    assert not is_overfit(run)
    run.records.add(8, "evaluate", split="train", downscale=1, psnr=40.0, ssim=1.0)
    run.records.write()
    assert "40.0 dB on training views" in overfitting_note(run)
    assert "dB on test views, more than 6 dB apart: the model overfits" in overfitting_note(run)
    assert "`scene.validation: auto` with `optimize.keep: best`" in overfitting_note(run)
    assert is_overfit(run)
