"""The dry run before preparation, and its time estimates."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Cell
from clsplat.prepare.matching import MAX_EXHAUSTIVE, max_pair_count
from clsplat.runs import estimate as module
from clsplat.runs.describe import describe
from clsplat.runs.opening import check_preparation, expect_measures, list_photo_names
from clsplat.runs.state import RunState
from clsplat.stages.optimize import Optimize
from clsplat.sweeps.batch import prepare_cell
from clsplat.sweeps.cell import Scenes
from clsplat.sweeps.experiment import Job, run_pipeline
from clsplat.sweeps.store import Store

COUNT = 23


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (folder := tmp_path / "photos").mkdir()
    for number in range(COUNT):
        cv2.imwrite(str(folder / f"{number:02d}.png"), np.zeros((60, 80, 3), np.uint8))
    return folder


def expected(pipeline: str, photos: Path, *sets: str) -> list[str]:
    """The lines, of a device with two compute units."""
    asked = load(pipeline, [f"scene.path='{photos}'", *sets])
    out = photos.parent / "runs" / "a"
    planned = asked.preparation(out)
    names = list_photo_names(asked, planned, out)
    device = SimpleNamespace(info=SimpleNamespace(units=2))
    return module.estimate_time(asked, planned, names, expect_measures(asked, names), device, None)  # type: ignore[arg-type]


def test_time_estimates_scale_with_the_work(photos):
    """23 photographs have 253 pairs; 20 are trained on, until 5 measurements 350 steps apart and a refit of 350, or
    7,000 steps and as many again."""
    steps = ", ".join(f"{{stage: {name}}}" for name in ("find_features", "match_features", "map_cameras", "undistort"))
    refit = "scene.validation=auto", "optimize.keep=best", "optimize.patience=4", "optimize.refit=true"
    lines = expected("splat_7k", photos, f"prepare=[{steps}]", *refit, "densify.max_gaussians=9600")
    assert [line.split()[0] for line in lines] == [
        "expected:", "find_features", "match_features", "map_cameras", "undistort", "optimize",
    ]  # fmt: skip
    assert lines[1].endswith(f"0.1 to {23 * 3 / 60:.1f} min: 23 photos")
    assert lines[2].endswith(f"{253 * 0.05 / 60:.1f} to {253 / 60:.1f} min: 253 pairs")
    assert "2,100 to 14,000 steps of 2 to 19 ms, with 5,000 to 9,600 Gaussians at 80x60 px" in lines[-1]
    assert lines[-1].split()[1:4] == ["0.1", "to", "4.4"]


def test_estimated_growth_follows_the_limit(photos):
    for path in photos.iterdir():
        cv2.imwrite(str(path), np.zeros((120, 160, 3), np.uint8))
    lines = expected("photos", photos, "optimize.during.1.max_gaussians=11520")
    assert "with 5,000 to 11,520 Gaussians at 160x120 px" in lines[-1]
    assert "11,520" not in expected("photos", photos)[-1]


@pytest.mark.parametrize(
    ("sets", "training"),
    [
        ((), 20),
        (("scene.holdout=0",), 23),
        (("scene.holdout={every: 8, offset: 7}",), 21),
        (("scene.holdout={names: [00.png, 05.png]}",), 21),
        (("scene.train={every: 4}",), 5),
        (("scene.validation=auto",), 20),
        (("scene.validation={names: ['04']}",), 20),
        (("scene.holdout={names: [00.jpg, 01.JPG]}",), 21),
    ],
)
def test_unprepared_photographs_give_the_training_count(photos, sets, training):
    pipeline = load("photos", [f"scene.path='{photos}'", *sets])
    out = photos.parent / "runs" / "a"
    names = list_photo_names(pipeline, pipeline.preparation(out), out)
    assert len(names) == COUNT
    assert expect_measures(pipeline, names).photograph_count == training
    assert expect_measures(pipeline, []) is None


def as_cell(asked, state, device, start):
    return prepare_cell(Cell("a", asked), Scenes(state.out.parent / "scenes"), Store(state.out.parent))


@pytest.mark.parametrize(
    ("begin", "sets", "complaint"),
    [
        (describe, "scene.holdout={names: [03.png, other.png]}", "no photo is named 'other.png'"),
        (run_pipeline, "scene.holdout={names: [03.png, other.png]}", "no photo is named 'other.png'"),
        (as_cell, "scene.holdout={names: [03.png, other.png]}", "no photo is named 'other.png'"),
        (describe, "scene.holdout={file: list.txt}", "list.txt"),
        (run_pipeline, "scene.validation={names: [other]}", "scene.validation: the list of names: no photo is"),
        (as_cell, "scene.train={names: [other.png]}", "no photo is named 'other.png'"),
        (describe, "scene.holdout=1", "every image is held out for testing"),
        (run_pipeline, "scene.holdout={every: 1}", "scene.holdout selects all 23 photos"),
        (as_cell, "scene.validation=1", "scene.validation selects 20 of 20 training photos"),
        (describe, "scene.train={every: 99, offset: 98}", "scene.train leaves no photo to train on"),
        (run_pipeline, "scene={train: {names: ['01']}, validation: auto}", "has 1 training photo; expected"),
        (as_cell, "scene={train: {names: ['01', '02']}, validation: {names: ['05']}}", "'05' is left out by scene"),
        (run_pipeline, "scene.masks=masks", "masks must fit the undistorted photos"),
        (as_cell, "scene={holdout: {names: ['00']}, validation: {names: [00.jpg]}}", "'00.jpg' is a test view"),
    ],
)
def test_impossible_split_is_refused_before_preparation(photos, begin, sets, complaint):
    pipeline = load("photos", [sets, f"scene.path='{photos}'"])
    with pytest.raises((ConfigError, DataError), match=complaint):
        begin(pipeline, RunState.read(photos.parent / "runs" / "a"), None, "new")
    assert not (photos.parent / "runs" / "prepared").exists()


def test_split_that_depends_on_cameras_is_not_refused_early(photos, caplog):
    """Which photographs a number holds out follows from those that are placed."""
    pipeline = load("photos", [f"scene.path='{photos}'", "scene.train={names: [00.png, '08', 01.jpg]}"])
    (photos / "left.heic").write_bytes(b"")
    out = photos.parent / "runs" / "a"
    check_preparation(pipeline, out)
    assert "HEIC" not in caplog.text, "the step that leaves it out says so"
    apart = "scene={train: {every: 2}, validation: {names: ['02', '05']}}"
    left_out = load("photos", [apart, f"scene.path='{photos}'"])
    check_preparation(left_out, out)
    assert "is refused: " in (described := describe(left_out, RunState.read(out), None, "new"))
    assert "'02' is left out by scene.train" in described
    text = describe(pipeline, RunState.read(out), None, "new")
    assert "if all 23 photos get a camera, the run is refused:" in text
    assert "'00.png' is a test view" in text
    assert "chosen from the photos: init.transparent, " in text, "what they will decide"


def test_skipped_files_are_reported_once(photos, caplog):
    (photos / "left.heic").write_bytes(b"")
    Job.open("photos", photos, photos.parent / "runs" / "a").describe()
    assert len([record for record in caplog.records if "HEIC" in record.getMessage()]) == 1


def test_dry_run_lists_the_undecided_settings(photos):
    pipeline = load("photos", [f"scene.path='{photos}'", "optimize.modules.dropout={probability: 0.1}"])
    lines = [
        line.strip()
        for line in describe(pipeline, RunState.read(photos.parent / "runs" / "a"), None, "new").splitlines()
    ]
    (actual,) = [line for line in lines if line.startswith("adapt ")]
    assert "chosen from the photos: init.transparent, init.count, " in actual
    assert "dropout" not in actual


def test_existing_cameras_need_no_time(tiny_scene, tmp_path):
    """A scene that holds cameras has a line for its training alone; nothing is written."""
    text = Job.open("smoke", tiny_scene, tmp_path / "run").describe()
    parts = text[text.index("expected:") :].splitlines()
    assert [line.split()[0] for line in parts] == ["expected:", "optimize"]
    assert not list(tmp_path.iterdir())
    pipeline = load("smoke", [f"scene.path='{tiny_scene}'"])
    assert "expected" not in describe(pipeline, RunState.read(tmp_path / "run"), None, "new"), (
        "cells of a matrix are many"
    )


@pytest.mark.parametrize("count", [2, 11, MAX_EXHAUSTIVE, MAX_EXHAUSTIVE + 1])
def test_pairs_are_exhaustive_or_sequential(count):
    every = count * (count - 1) // 2
    assert max_pair_count(count, "exhaustive", 10) == every
    assert max_pair_count(count, "auto", 10) == (every if count <= MAX_EXHAUSTIVE else 20 * count)
    assert max_pair_count(count, "sequential", 10) == min(every, 20 * count)


@pytest.mark.parametrize(
    ("keys", "fewest"),
    [
        ({}, 7000),
        ({"keep": "best"}, 7000),
        ({"keep": "best", "patience": 4}, 1750),
        ({"keep": "best", "patience": 40}, 7000),
    ],
)
def test_patience_gives_the_fewest_steps(keys, fewest):
    training = {"steps": 7000, "losses": [{"type": "l1"}], **keys}
    assert Optimize.model_validate(training).min_steps == fewest
    if "patience" in keys:
        assert Optimize.model_validate({**training, "refit": True}).min_steps == fewest + 350
