"""What a dry run says of the time that a run takes: parts are tried, and what they take is continued."""

from pathlib import Path
from tempfile import gettempdir
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
import pytest

from clsplat.cluster.batch import wanted_cell
from clsplat.cluster.fingerprint import Scenes
from clsplat.cluster.store import Store
from clsplat.errors import ConfigError, DataError
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Cell
from clsplat.prepare.cache import plan
from clsplat.prepare.matching import MAX_EXHAUSTIVE, most_pairs
from clsplat.prepare.steps import FindFeatures, MapCameras, MatchFeatures, Step, Undistort
from clsplat.runs import expected as module
from clsplat.runs.description import describe
from clsplat.runs.experiment import Job
from clsplat.runs.single import run_pipeline
from clsplat.runs.unprepared import check_preparation, known, listed
from clsplat.settings import Settings
from clsplat.stages.optimize import Optimize
from tests.refusals import refusal

COUNT = 23
SKY = "of the training photographs show a sky"
KEEP = "choices=[{keys: [optimize.keep, scene.validation], by: photographs, values: [[0, best, auto]], since: x}]"


class List(Step):
    """Writes the names of its photographs."""

    tried: ClassVar[list[list[str]]] = []

    stage: Literal["list"] = "list"

    def pieces(self, photographs: int) -> tuple[int, str] | None:
        return photographs, "photographs"

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        self.tried.append(sorted(path.name for path in source.iterdir()))
        return {}


Settings.defined.remove(List)  # not a step in other tests


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (folder := tmp_path / "photos").mkdir()
    for number in range(COUNT):
        cv2.imwrite(str(folder / f"{number:02d}.png"), np.zeros((60, 80, 3), np.uint8))
    return folder


def expected(pipeline: str, photos: Path, monkeypatch: pytest.MonkeyPatch, *sets: str) -> list[str]:
    """The lines, where features of three photographs take 3 s, their matches 6 s, and a step a millisecond for each
    1,000 Gaussians."""
    monkeypatch.setattr(module, "_tried", lambda *_: {"find_features": 3.0, "match_features": 6.0})
    monkeypatch.setattr(module, "_step", lambda device, size, count, settings: count / 1e6)
    asked = load(pipeline, [f"scene.path='{photos}'", *sets])
    out = photos.parent / "runs" / "a"
    planned = asked.preparation(out)
    names = listed(asked, planned, out)
    return module.expected(asked, planned, names, known(asked, names), None, None)  # type: ignore[arg-type]


def test_parts_are_continued_by_the_number_of_their_pieces(photos, monkeypatch):
    """23 photographs have 253 pairs; 20 are trained on, until 5 measurements 350 steps apart and a refit of 350, or
    7,000 steps and as many again."""
    steps = ", ".join(f"{{stage: {name}}}" for name in ("find_features", "match_features", "map_cameras", "undistort"))
    refit = "scene.validation=auto", "optimize.keep=best", "optimize.patience=4", "optimize.refit=true"
    sets = f"prepare=[{steps}]", *refit, "densify.per_pixel=2"
    lines = expected("splat_7k", photos, monkeypatch, *sets)
    assert lines[1].split()[:4] == ["find_features", f"{23 / 90:.1f}", "to", f"{23 / 40:.1f}"]
    assert lines[2].split()[:4] == ["match_features", f"{2 * 253 / 90:.1f}", "to", f"{2 * 253 / 40:.0f}"]
    assert [line.split()[0] for line in lines[3:]] == ["map_cameras", "undistort", "optimize"]
    assert all("a guess" in line for line in lines[3:])
    assert "2,100 to 14,000 steps of 5 to 10 ms, with 5,000 to 9,600 Gaussians at 80x60 px" in lines[-1]
    assert lines[-1].split()[1:4] == ["0.2", "to", "2.2"]
    assert lines[0].startswith("expected: ")


def test_the_number_of_photographs_tells_the_growth_that_would_be_chosen(photos, monkeypatch):
    """Whether they show a sky is not known before they are prepared."""
    for path in photos.iterdir():
        cv2.imwrite(str(path), np.zeros((120, 160, 3), np.uint8))
    lines = expected("photos", photos, monkeypatch)
    assert "with 5,000 to 11,520 Gaussians at 160x120 px" in lines[-1], "0.6 for each pixel"
    for number in range(COUNT, 2 * COUNT + 1):
        cv2.imwrite(str(photos / f"{number:02d}.png"), np.zeros((120, 160, 3), np.uint8))
    assert "11,520" not in expected("photos", photos, monkeypatch)[-1]


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
def test_photographs_that_are_not_prepared_tell_how_many_train(photos, sets, training):
    asked = load("photos", [f"scene.path='{photos}'", *sets])
    out = photos.parent / "runs" / "a"
    names = listed(asked, asked.preparation(out), out)
    assert len(names) == COUNT
    assert known(asked, names) == {"photographs": training}
    assert known(asked, []) == {}


def as_cell(asked, out, device, start):
    return wanted_cell(Cell("a", asked), Scenes(out.parent / "scenes"), Store(out.parent))


@pytest.mark.parametrize("begin", [describe, run_pipeline, as_cell])
@pytest.mark.parametrize(
    ("sets", "complaint"),
    [
        ("scene.holdout={names: [03.png, other.png]}", "no photograph is called 'other.png'"),
        ("scene.holdout={file: list.txt}", "list.txt"),
        ("scene.validation={names: [other]}", "scene.validation: the list of names: no photograph is called 'other'"),
        ("scene.train={names: [other.png]}", "no photograph is called 'other.png'"),
        ("scene.holdout=1", "every image is held out for testing"),
        ("scene.holdout={every: 1}", "scene.holdout takes all 23 photographs"),
        ("scene.validation=1", "scene.validation takes 20 of 20 training photographs"),
        ("scene.train={every: 99, offset: 98}", "scene.train leaves no photograph to train with"),
        ("scene={train: {names: ['01']}, validation: auto}", "has 1 training photograph; expected 4 or more"),
        ("scene={train: {names: ['01', '02']}, validation: {names: ['05']}}", "'05' is left out by scene.train"),
        ("scene.masks=masks", "prepared photographs have another shape"),
        ("scene={holdout: {names: ['00']}, validation: {names: [00.jpg]}}", "'00.jpg' is held out for testing"),
    ],
)
def test_a_split_that_photographs_do_not_have_is_refused_before_they_are_prepared(photos, begin, sets, complaint):
    asked = load("photos", [sets, f"scene.path='{photos}'"])
    with pytest.raises((ConfigError, DataError), match=complaint):
        begin(asked, photos.parent / "runs" / "a", None, "new")
    assert not (photos.parent / "runs" / "prepared").exists()


def test_a_list_is_not_refused_for_what_is_known_when_cameras_are(photos, caplog):
    """Which photographs a number holds out follows from those that are placed."""
    asked = load("photos", [f"scene.path='{photos}'", "scene.train={names: [00.png, '08', 01.jpg]}"])
    (photos / "left.heic").write_bytes(b"")
    out = photos.parent / "runs" / "a"
    check_preparation(asked, out)
    assert "HEIC" not in caplog.text, "the step that leaves it out says so"
    apart = "scene={train: {every: 2}, validation: {names: ['02', '05']}}"
    left_out = load("photos", [apart, f"scene.path='{photos}'"])
    check_preparation(left_out, out)
    assert "is refused: " in (described := describe(left_out, out, None, "new"))
    assert "'02' is left out by scene.train" in described
    told = describe(asked, out, None, "new")
    assert "if all 23 photographs are placed, the run is refused:" in told
    assert "'00.png' is held out for testing" in told
    assert "model.background=null; {" in told, "what may be chosen"


def test_files_that_are_left_out_are_told_once(photos, caplog):
    (photos / "left.heic").write_bytes(b"")
    Job.open("photos", photos, photos.parent / "runs" / "a").describe()
    assert len([record for record in caplog.records if "HEIC" in record.getMessage()]) == 1


def test_a_dry_run_says_what_can_be_chosen_before_photographs_are_prepared(photos):
    asked = load("photos", [f"scene.path='{photos}'", "optimize.dropout=0.1"])
    lines = [line.strip() for line in describe(asked, photos.parent / "runs" / "a", None, "new").splitlines()]
    fixed = [line for line in lines if ", since 20 training photographs; " in line]
    assert [line.partition("=")[0] for line in fixed] == ["init.transparent", "optimize.dropout", "model.background"]
    assert fixed[1].startswith("optimize.dropout=0.1, ")
    growth = "stages.1.during.1.per_pixel"
    assert f"{growth}=0.6; 0.3 if at least 25% {SKY}; 0.1 if at least 50% {SKY}" in lines
    assert "choices        if all 23 photographs are placed:" in lines
    together = load("photos", [f"scene.path='{photos}'", KEEP, "scene.validation=0"])
    assert "with which the rest does not go together" in describe(together, photos.parent / "runs" / "a", None, "new")


def test_what_is_there_already_takes_no_time(tiny_scene, tmp_path):
    """A scene that holds cameras has a line for its training alone; nothing is written."""
    text = Job.open("smoke", tiny_scene, tmp_path / "run").describe()
    parts = text[text.index("expected:") :].splitlines()
    assert [line.split()[0] for line in parts] == ["expected:", "optimize"]
    assert not list(tmp_path.iterdir())
    asked = load("smoke", [f"scene.path='{tiny_scene}'"])
    assert "expected" not in describe(asked, tmp_path / "run", None, "new"), "cells of a matrix are many"


def test_three_photographs_that_follow_each_other_are_tried(photos, tmp_path):
    List.tried.clear()
    steps = plan([List(), List()], photos, tmp_path / "runs" / "prepared")
    names = sorted(path.name for path in photos.iterdir())
    assert set(module._tried(steps, photos, names)) == {"list"}
    assert List.tried == [["10.png", "11.png", "12.png"], []]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_damaged_photographs_are_passed_over(photos, tmp_path):
    List.tried.clear()
    steps = plan([List()], photos, tmp_path / "runs" / "prepared")
    names = sorted(path.name for path in photos.iterdir())
    (photos / "11.png").write_bytes(b"")
    module._tried(steps, photos, names)
    for name in names[10:21]:
        (photos / name).write_text("hello")
    module._tried(steps, photos, names)
    assert List.tried == [["10.png", "12.png", "13.png"], ["09.png", "21.png", "22.png"]]
    for name in names[2:]:
        (photos / name).write_bytes(b"")
    assert refusal(module._tried, steps, photos, names) == f"{photos}: 2 of 23 photographs can be read, 3 are needed"


def test_an_estimate_without_the_preparation_says_so_and_names_no_temporary_path(photos, monkeypatch, caplog):
    def make(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        raise DataError(f"{source / '11.png'}: broken by {out / 'database.db'}: no space")

    monkeypatch.setattr(FindFeatures, "make", make)
    monkeypatch.setattr(module, "_step", lambda device, size, count, settings: count / 1e6)
    asked = load("photos", [f"scene.path='{photos}'"])
    out = photos.parent / "runs" / "a"
    planned = asked.preparation(out)
    names = listed(asked, planned, out)
    lines = module.expected(asked, planned, names, known(asked, names), None, None)
    assert "without the preparation, measurements, pictures and pages" in lines[0]
    assert (
        f"is not in what is expected: find_features: {photos / '11.png'}: broken by find_features/database.db: no space"
        in caplog.text
    )
    assert gettempdir() not in caplog.text.replace(str(photos.parent), "")


@pytest.mark.parametrize("count", [2, 11, MAX_EXHAUSTIVE, MAX_EXHAUSTIVE + 1])
def test_pairs_are_all_of_them_or_those_of_neighbours(count):
    every = count * (count - 1) // 2
    assert most_pairs(count, "exhaustive", 10) == every
    assert most_pairs(count, "auto", 10) == (every if count <= MAX_EXHAUSTIVE else 20 * count)
    assert most_pairs(count, "sequential", 10) == min(every, 20 * count)


def test_the_steps_that_are_tried_come_first():
    steps = FindFeatures(), MatchFeatures(), MapCameras(), Undistort()
    assert [one.pieces(3) for one in steps] == [(3, "photographs"), (3, "pairs"), None, None]
    assert [one.of_first is None for one in steps] == [True, True, False, False]


@pytest.mark.parametrize(
    ("keys", "fewest"),
    [
        ({}, 7000),
        ({"keep": "best"}, 7000),
        ({"keep": "best", "patience": 4}, 1750),
        ({"keep": "best", "patience": 40}, 7000),
    ],
)
def test_patience_says_how_early_a_training_may_end(keys, fewest):
    training = {"steps": 7000, "losses": [{"type": "l1"}], **keys}
    assert Optimize.model_validate(training).fewest_steps == fewest
    if "patience" in keys:
        assert Optimize.model_validate({**training, "refit": True}).fewest_steps == fewest + 350


def test_a_step_is_timed_on_a_made_scene(device: Device):
    """Of few Gaussians, and beyond those that are measured on the line through two numbers of them."""
    settings = load("smoke").settings
    few, many = module.step_seconds(device, (70, 50), (100, 1000), settings)
    assert 0 < few <= many
