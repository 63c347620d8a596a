"""Whole runs on a tiny scene: the loss decreases, and repeated and resumed runs have the same bits."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError, Interrupted, NumericError
from clsplat.core.progress import Progress
from clsplat.formats.ply import write_ply
from clsplat.formats.table import read as read_ply
from clsplat.photos.sampling import Sampler
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from clsplat.runs.failures import recording_failures
from clsplat.training import checkpoint
from tests.support.onnx_writer import distance_network
from tests.support.runs import FEW, ONE_CORE, digest, train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "finished"
    train(tiny_scene, out)
    return out


def test_run_writes_its_outputs(finished, tiny_scene):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["steps"] == 50
    assert metrics["pipeline"] == "smoke"
    assert metrics["test"]["1"]["views"] == 2
    assert metrics["test"]["1"]["lpips"] is None
    assert metrics["gaussians"] == len(read_ply(finished / "point_cloud.ply").parameters["means"])
    assert json.loads((finished / "status.json").read_text())["state"] == "done"
    assert len(list((finished / "renders").rglob("*.png"))) == 2
    report = (finished / "report.html").read_text()
    assert report.count("<img") == 6
    assert "<polyline" in report
    assert load(str(finished / "pipeline.yaml")).settings.name == "smoke"
    assert len(list((finished / "checkpoints").iterdir())) == 2
    assert not [path for path in finished.rglob(".*")], "temporary files are left"


def test_loss_decreases_and_density_changes(finished):
    lines = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    loss = [line["loss"] for line in lines if line["kind"] == "train"]
    assert loss[-1] < 0.6 * loss[0]
    edits = [line for line in lines if line["kind"] == "densify"]
    assert [line["step"] for line in edits] == [20, 30, 40]
    assert any(line["after"] > line["before"] for line in edits)


def test_one_core_gives_the_same_bits(finished, tiny_scene, tmp_path):
    command = [
        sys.executable,
        "-m",
        "clsplat",
        "run",
        "smoke",
        "--scene",
        str(tiny_scene),
        "--out",
        str(tmp_path / "one"),
    ]
    subprocess.run(command, check=True, env={**os.environ, **ONE_CORE}, capture_output=True)
    assert digest(tmp_path / "one") == digest(finished)


def test_more_metrics_are_recorded(tiny_scene, tmp_path):
    (tmp_path / "distance.onnx").write_bytes(distance_network())
    metrics = "evaluate.metrics=[psnr, ssim, ms_ssim]"
    run = train(tiny_scene, tmp_path / "run", "optimize.steps=3", metrics, f"evaluate.lpips='{tmp_path}/distance.onnx'")
    averages = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]["1"]
    views = run.records.read("view")
    for name in ("psnr", "ssim", "ms_ssim", "lpips"):
        assert averages[name] == pytest.approx(np.mean([view[name] for view in views]))
    assert f"{averages['lpips']:.4f}" in (tmp_path / "run" / "report.html").read_text()
    with pytest.raises(DataError, match="nowhere"):
        train(tiny_scene, tmp_path / "early", "evaluate.lpips=nowhere.onnx")
    assert not (tmp_path / "early" / "metrics.jsonl").exists(), "refused before training"


def test_another_seed_gives_other_bits(few_steps, tiny_scene, tmp_path):
    train(tiny_scene, tmp_path / "seed", *FEW, "seed=1")
    assert digest(tmp_path / "seed") != digest(few_steps)


@pytest.mark.parametrize("sort", ["radix", "bitonic"])
def test_sort_does_not_change_the_bits(few_steps, tiny_scene, tmp_path, sort):
    train(tiny_scene, tmp_path / sort, *FEW, f"rasterizer.sort={sort}")
    assert digest(tmp_path / sort) == digest(few_steps)


def test_interrupt_saves_and_resume_continues(few_steps, tiny_scene, tmp_path):
    out = tmp_path / "stopped"
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW])
    run = opening.open_run(checked, out, None)

    def stop(progress: Progress) -> None:
        run.interrupted = progress.step == 5

    with pytest.raises(Interrupted, match="stopped at step 5"), recording_failures(run.status):
        runner.execute(checked, run, "new", stop)
    assert json.loads((out / "status.json").read_text())["state"] == "interrupted"
    train(tiny_scene, out, *FEW, resume=True)
    assert digest(out) == digest(few_steps)
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    steps = [line["step"] for line in lines if line["kind"] == "train"]
    assert steps == sorted(set(steps))


def test_checkpoint_of_another_format_is_refused(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 1)
    train(tiny_scene, tmp_path, *FEW, "optimize.steps=4")
    monkeypatch.undo()
    before = (tmp_path / "metrics.jsonl").read_bytes()
    with pytest.raises(ConfigError, match=r"has format 1, expected 5.*use another --out"):
        train(tiny_scene, tmp_path, *FEW, "optimize.steps=4", resume=True)
    assert (tmp_path / "metrics.jsonl").read_bytes() == before


def test_other_settings_are_refused_on_resume(killed_run, tiny_scene):
    with pytest.raises(ConfigError, match=r"stages\[0\].init.count was 60, is 1000"):
        train(tiny_scene, killed_run, *FEW, "init.count=1000", resume=True)
    with pytest.raises(ConfigError, match="already has a run"):
        train(tiny_scene, killed_run)


def test_checkpoints_contain_the_whole_state(finished, tiny_scene):
    path = sorted((finished / "checkpoints").glob("*.npz"))[-1]
    with np.load(path, allow_pickle=False) as archive:
        names = set(archive.files)
        meta = json.loads(str(archive["meta"]))
    for table in ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest"):
        assert {f"gaussians/{table}", f"adam/{table}/moment1", f"adam/{table}/moment2"} <= names
    assert {"gaussians/filter_variance", "stats/screen_grad", "stats/seen"} <= names
    assert (meta["step"], meta["degree"]) == (50, 1)


def test_nonfinite_values_stop_the_run(tiny_scene, tmp_path):
    with pytest.raises(NumericError, match=r"step 10, view '.*': the loss is .*not finite: .*sh_base") as error:
        train(tiny_scene, tmp_path, "optimize.rates.sh_base=1e38")
    assert error.value.exit_code == 6
    assert json.loads((tmp_path / "status.json").read_text())["exit_code"] == 6


def test_empty_model_is_refused_as_a_start(tiny_scene, tmp_path):
    path = tmp_path / "empty.ply"
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": 45}
    write_ply(path, {name: np.zeros((0, width), np.float32) for name, width in widths.items()}, {})
    with pytest.raises(DataError, match=r"empty\.ply: the model has no Gaussians"):
        train(tiny_scene, tmp_path / "run", "init.source=model", f"init.file='{path}'")


def test_views_come_in_random_order_without_repeats(tiny_scene, tmp_path):
    checked = load("smoke", [f"scene.path='{tiny_scene}'"])
    run = opening.open_run(checked, tmp_path, None)
    sampler = Sampler(run.scene.split("train"), checked.settings.training.views, run.seed)
    names = [sampler.at(step).view.name for step in range(1, 25)]
    epochs = [names[i : i + 8] for i in (0, 8, 16)]
    for epoch in epochs:
        assert len(set(epoch)) == 8
    assert epochs[0] != epochs[1] != epochs[2]
