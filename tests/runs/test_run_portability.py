"""A run folder is accepted as model and scene, a finished run can be continued, and the summary lists its files."""

import json
import shutil
from pathlib import Path

import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.gaussians.model import load
from clsplat.prepare.gather import summarize_placement
from clsplat.runs.model_file import ModelSource, find_run, photo_folder
from clsplat.runs.status import summarize_run
from clsplat.sweeps.experiment import Job
from tests.support.html_page import Page
from tests.support.runs import digest, steps_saved, train

pytestmark = pytest.mark.slow
FILE = "export.file=models/last.ply"
FOUND = {"map_cameras": {"registered": 32, "not_registered": ["IMG_0034.jpg"], "error_px": 1.268}}


@pytest.fixture(scope="module")
def done(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of ten steps whose model has a name and a place of its own."""
    out = tmp_path_factory.mktemp("everywhere") / "run"
    train(tiny_scene, out, "optimize.steps=10", "scene.downscale=2", FILE)
    return out


def test_run_folder_is_a_model(done):
    model = done / "models/last.ply"
    assert find_run(done) == done
    assert find_run(model) == done.resolve()
    assert len(load(done)) == len(load(model))
    shutil.copy(model, done.parent / "copy.ply")
    assert find_run(done.parent / "copy.ply") is None


def test_model_of_a_run_has_its_scene(done, tiny_scene):
    for model in (done, done / "models/last.ply"):
        source = ModelSource.from_model(model, None)
        assert (source.file.name, source.folder, source.settings.downscale) == ("last.ply", tiny_scene, 2)
    copy = done.parent / "copy.ply"
    shutil.copy(done / "models/last.ply", copy)
    with pytest.raises(ConfigError, match="does not name its scene"):
        ModelSource.from_model(copy, None)
    assert ModelSource.from_model(copy, done).settings.downscale == 2, "as the run read it"
    assert ModelSource.from_model(copy, tiny_scene).settings.downscale == 1


def test_run_folder_is_a_scene(done, tiny_scene, tmp_path):
    assert photo_folder(done) == tiny_scene
    assert photo_folder(tiny_scene) == tiny_scene
    assert clsplat.inspect_scene(done).is_trainable
    assert Job.open("smoke", done, tmp_path / "run").work.settings.scene.folder == tiny_scene
    moved = shutil.copytree(done, tmp_path / "moved")
    (moved / "prepared.json").write_text('{"inputs": "x", "folder": "/nowhere"}')
    with pytest.raises(DataError, match="the folder of its photos, /nowhere, is missing"):
        photo_folder(moved)


def test_finished_run_trains_longer(done, tiny_scene, tmp_path):
    """Its last step is in a checkpoint, whatever the cadence; the longer run starts from there."""
    out = shutil.copytree(done, tmp_path / "run")
    assert steps_saved(out)[-1] == "step_000010.npz"
    clsplat.resume(out, set={"optimize.steps": 14})
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["steps"], len(metrics["changes"])) == (14, 1)
    before = digest_of(out)
    clsplat.resume(out)
    assert digest_of(out) == before, "nothing is left to train"


def test_finished_run_without_checkpoints_is_not_retrained(tiny_scene, tmp_path):
    pipeline = tmp_path / "plain.yaml"
    stages = ["init: {source: random, count: 50}", "optimize: {steps: 3, losses: [l1]}", "export"]
    pipeline.write_text("name: plain\nstages:\n" + "".join(f"  - {stage}\n" for stage in stages))
    out = clsplat.run(pipeline, tiny_scene, tmp_path / "run")
    before = digest(out)
    with pytest.raises(
        ConfigError, match=r"is finished, but has no checkpoint to continue from; .* --restart` trains it"
    ):
        clsplat.resume(out, set={"optimize.steps": 4})
    assert digest(out) == before


def test_summary_lists_metrics_and_files(done, tiny_scene):
    lines = summarize_run(done)
    assert lines[0].startswith("test PSNR ")
    assert f"  scene    {tiny_scene}" in lines
    assert f"  model    {done}/models/last.ply" in lines
    assert f"  report   {done}/report.html" in lines
    assert lines[-1].endswith(f"`clsplat resume {done} --steps 20` trains longer")
    spent = json.loads((done / "metrics.json").read_text())["seconds"]
    assert {"init", "optimize", "evaluate", "export"} <= spent.keys()


def test_summary_offers_no_more_steps_to_an_overfit_model(done, tmp_path):
    folder = shutil.copytree(done, tmp_path / "run")
    metrics = json.loads((folder / "metrics.json").read_text())
    (folder / "metrics.json").write_text(json.dumps({**metrics, "overfit": True}))
    assert summarize_run(folder)[-1].endswith("in a browser; the model overfits: add photos")


def test_summary_names_missing_photographs(done, tmp_path):
    text = summarize_placement(FOUND)
    assert text == "32 of 33 photos registered, reprojection error 1.27 px; left out: IMG_0034.jpg"
    assert summarize_placement({}) == summarize_placement({"map_cameras": {"registered": "x"}}) == ""
    many = {"map_cameras": {**FOUND["map_cameras"], "not_registered": [f"{i}.jpg" for i in range(10)]}}
    assert summarize_placement(many).endswith("7.jpg, and 2 more")
    metrics = json.loads((done / "metrics.json").read_text())
    (tmp_path / "metrics.json").write_text(
        json.dumps({**metrics, "preparation": FOUND | {"undistort": {"seconds": 7.2}}})
    )
    text = "\n".join(summarize_run(tmp_path))
    assert "; 32 of 33 photos registered" in text
    assert "undistort 7 s" in text


def test_report_starts_with_images_and_cameras(done, tiny_scene):
    text = (done / "report.html").read_text()
    page = Page(text)
    titles = ["The worst views", "Photos", "Summary", "Settings"]
    places = [text.index(f"<h2>{title}</h2>") for title in titles]
    assert places == sorted(places)
    assert text.count(f"<h1>{tiny_scene.name}</h1>") == 1
    assert 'href="models/last.ply"' in text
    assert "cameras from above" in text
    assert page.elements["button"] == page.elements["img"], "each picture grows"


def test_comparison_links_the_reports_and_names_the_seeds(tiny_scene, tmp_path):
    runs = [tmp_path / f"seed {seed}" for seed in (0, 1)]
    for seed, out in enumerate(runs):
        train(tiny_scene, out, "optimize.steps=10", "optimize.log_every=5", f"seed={seed}")
    clsplat.compare_runs(runs, tmp_path / "pages/compare.html")
    text = (tmp_path / "pages/compare.html").read_text()
    assert 'href="../seed%200/report.html"' in text
    assert "A seed 0" in text
    assert "A seed 1" in text


def digest_of(out: Path) -> bytes:
    return (out / "models/last.ply").read_bytes()
