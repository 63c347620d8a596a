"""Training, validation, and test views, and photographs that a dataset lists but lacks."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.loading import load
from clsplat.runs.describe import describe
from clsplat.runs.opening import RunScene
from clsplat.runs.state import RunState
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity
from clsplat.scene.scene import Scene, Tracks
from clsplat.scene.view_selection import Split, ViewSelection
from tests.support.transforms_scene import LENS, frames, write

LETTERS = "abcdefghijklmnopqrstuvwx"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A nerfstudio scene of 24 photographs, images/a.png to images/x.png."""
    write(tmp_path, **LENS, frames=frames(*(f"images/{letter}.png" for letter in LETTERS)))
    return tmp_path


def letters(scene: Scene, split: str) -> str:
    return "".join(Path(view.name).stem for view in scene.split(split))


def test_every_nth_view_from_an_offset_is_for_testing(folder):
    scene = read_scene(folder, Split(ViewSelection(every=8, offset=4)))
    assert letters(scene, "test") == "emu"
    assert len(scene.train) == 21
    assert scene.extent == pytest.approx(read_scene(folder, 8).extent, rel=1)


@pytest.mark.parametrize(
    "split", [{"holdout": ViewSelection(every=3, offset=1)}, {"train": ViewSelection(every=2)}, {"validation": 2}]
)
def test_split_changes_only_the_views(folder, split):
    scene = replace(read_scene(folder), tracks=Tracks(np.zeros((1, 3)), {}))
    result = Split(**split).apply(scene)
    assert (result.tracks, result.points, result.background) == (scene.tracks, scene.points, scene.background)
    assert {view.name for view in result.views} <= {view.name for view in scene.views}


@pytest.mark.parametrize("listed", ["b", "images/b.png", "images\\b.png", "b.jpg", "images/b.JPG"])
def test_listed_name_may_be_the_end_of_a_path(folder, listed):
    assert letters(read_scene(folder, Split(ViewSelection(names=[listed, "q"]))), "test") == "bq"


def test_exact_suffix_takes_precedence_over_others(tmp_path):
    write(tmp_path, **LENS, frames=frames("a/1.png", "a/1.jpg", "c.png"))
    scene = read_scene(tmp_path, Split(ViewSelection(names=["1.jpg"])))
    assert [view.name for view in scene.split("test")] == ["a/1.jpg"]


@pytest.mark.parametrize("listed", ["1.jpg", "1", "1.png"])
def test_full_path_takes_precedence_over_a_path_end(tmp_path, listed):
    write(tmp_path, **LENS, frames=frames("1.png", "a/1.png", "c.png"))
    scene = read_scene(tmp_path, Split(ViewSelection(names=[listed])))
    assert [view.name for view in scene.split("test")] == ["1.png"]


def test_listed_name_may_have_another_suffix(tmp_path):
    write(tmp_path, **LENS, frames=frames("a/1.png", "c.png"))
    scene = read_scene(tmp_path, Split(ViewSelection(names=["1.jpg"])))
    assert [view.name for view in scene.split("test")] == ["a/1.png"]


def test_file_lists_test_views(folder):
    (folder / "test.txt").write_text("# of the paper\nc.png\n\n x.png \n")
    assert letters(read_scene(folder, Split(ViewSelection(file="test.txt"))), "test") == "cx"


def test_split_file_may_be_next_to_unprepared_photos(folder, tmp_path_factory):
    lists = tmp_path_factory.mktemp("photographs")
    (lists / "test.txt").write_text("d\n")
    assert letters(read_scene(folder, Split(ViewSelection(file="test.txt"), folder=lists)), "test") == "d"


@pytest.mark.parametrize(
    ("choice", "fault"),
    [
        (ViewSelection(names=["bb.png"]), "no photo is named 'bb.png'; did you mean 'b.png'?"),
        (ViewSelection(names=["b.gif"]), "no photo is named 'b.gif'"),
        (ViewSelection(file="test.txt"), "test.txt: cannot be read"),
        (
            ViewSelection(names=list(LETTERS)),
            "scene.holdout selects all 24 photos for testing; name fewer photos",
        ),
        (ViewSelection(every=1), "scene.holdout selects all 24 photos"),
    ],
)
def test_invalid_list_is_refused(folder, choice, fault):
    with pytest.raises(DataError, match=fault.replace("?", r"\?")):
        read_scene(folder, Split(choice))


@pytest.mark.parametrize(
    "split", [Split(8, ViewSelection(names=["a", "i"])), Split(8, None, ViewSelection(names=["a", "b"]))]
)
def test_test_photograph_in_another_list_is_named(folder, split):
    with pytest.raises(DataError, match=r"scene\.(train|validation): the list of names: '[ai]' is a test view"):
        read_scene(folder, split)


def test_left_out_image_in_another_list_is_named(folder):
    fault = "scene.validation: the list of names: 'c' is left out by scene.train; .* or add it to scene.train"
    for train in (ViewSelection(every=2), ViewSelection(names=["b", "d"])):
        with pytest.raises(DataError, match=fault):
            read_scene(folder, Split(8, train, ViewSelection(names=["c"])))


def test_image_held_out_by_number_is_not_reported_as_left_out(folder):
    names = [f"images/{letter}.jpg" for letter in LETTERS]
    Split(8, ViewSelection(names=["b", "d"]), ViewSelection(names=["a"])).check(folder, names)  # the placed ones decide
    with pytest.raises(DataError, match=r"'c' is left out by scene\.train"):
        Split(8, ViewSelection(names=["b", "d"]), ViewSelection(names=["c"])).check(folder, names)


def test_ambiguous_name_is_refused(tmp_path):
    write(tmp_path, **LENS, frames=frames("a/1.png", "b/1.png", "c.png"))
    with pytest.raises(DataError, match=r"'1.png' matches 'a/1.png' and 'b/1.png'; use a longer part of the path"):
        read_scene(tmp_path, Split(ViewSelection(names=["1.png"])))


def test_dataset_split_applies_unless_names_are_listed(folder):
    table = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({**table, "test_filenames": ["images/a.png"]}))
    assert letters(read_scene(folder, Split(ViewSelection(every=8, offset=4))), "test") == "a"
    assert letters(read_scene(folder, Split(ViewSelection(names=["b"]))), "test") == "b"


def test_sparse_capture_is_every_nth_of_the_training_views(folder):
    whole = read_scene(folder, 8)
    scene = read_scene(folder, Split(8, ViewSelection(every=4)))
    assert letters(scene, "test") == letters(whole, "test") == "aiq"
    assert letters(scene, "train") == letters(whole, "train")[::4] == "bfkotx"
    assert len(scene.views) == 9, "the others are no views of the scene"


@pytest.mark.parametrize(
    ("train", "fold"),
    [(None, "fox"), (ViewSelection(every=4), "ft"), (ViewSelection(names=["b", "c", "d", "e"]), "ce")],
    ids=["21 training views", "6", "4"],
)
def test_fold_is_every_8th_training_view_and_at_least_two(folder, train, fold):
    scene = read_scene(folder, Split(8, train, "auto"))
    assert letters(scene, "validation") == fold
    assert not {*scene.train} & {*scene.validation}
    assert not {*scene.test} & {*scene.validation}
    without = read_scene(folder, Split(8, train))
    assert letters(scene.merge_validation(), "train") == letters(without, "train")
    assert scene.merge_validation().validation == ()
    assert scene.extent == without.extent, "the cameras are known, and only photos are kept out"
    halved = scene.downscaled(2)
    assert letters(halved, "validation") == fold


def test_explicit_fold_is_used(folder):
    assert letters(read_scene(folder, Split(0, None, ViewSelection(every=8, offset=4))), "validation") == "emu"
    assert letters(read_scene(folder, Split(0, None, 12)), "validation") == "am"


def test_too_large_fold_is_refused(folder):
    with pytest.raises(DataError, match="has 3 training photos; expected at least 4 to hold some out for validation"):
        read_scene(folder, Split(8, ViewSelection(names=["b", "c", "d"]), "auto"))
    with pytest.raises(DataError, match="selects 24 of 24 training photos"):
        read_scene(folder, Split(0, None, 1))


def test_run_detects_a_changed_fold(folder):
    whole, fold = (Identity.from_scene(read_scene(folder, Split(8, None, item)), {}) for item in (0, "auto"))
    assert whole.digest != fold.digest
    assert fold.changes(whole) == ["the split of 3 views (images/f.png, images/o.png, images/x.png)"]
    assert Identity.from_data(json.loads(json.dumps(fold.data()))) == fold


def test_listed_names_of_missing_photographs_are_skipped(folder, caplog):
    caplog.set_level(logging.INFO)
    for letter in "cx":
        (folder / f"images/{letter}.png").unlink()
    (folder / "names.txt").write_text("a\nc\nimages/x.jpg\nd\n")
    for choice in (ViewSelection(names=["a", "c", "c", "x.png", "d"]), ViewSelection(file="names.txt")):
        caplog.clear()
        scene = read_scene(folder, Split(choice, missing="skip"))
        assert letters(scene, "test") == "ad"
        assert "skipped 2 names whose photo is missing" in caplog.text
        assert letters(read_scene(folder, Split(0, validation=choice, missing="skip")), "validation") == "ad"
        assert letters(read_scene(folder, Split(0, train=choice, missing="skip")), "train") == "ad"
    with pytest.raises(DataError, match="no photo is named 'z'"):
        read_scene(folder, Split(ViewSelection(names=["a", "c", "z"]), missing="skip"))
    with pytest.raises(DataError, match=r"scene\.holdout selects 0 of .* name photos of the dataset"):
        read_scene(folder, Split(ViewSelection(names=["c"]), missing="skip"))
    with pytest.raises(DataError, match=r"scene\.train leaves no photo"):
        read_scene(folder, Split(0, train=ViewSelection(names=["c"]), missing="skip"))


def test_missing_photographs_are_refused_with_the_skip_setting(folder, caplog):
    for letter in "bc":
        (folder / "images" / f"{letter}.png").unlink()
    with pytest.raises(DataError, match=r"2 of 24 .* missing: .*restore them, or --set scene\.missing=skip"):
        read_scene(folder)
    caplog.set_level(logging.WARNING, "clsplat")
    scene = read_scene(folder, Split(8, missing="skip"))
    assert len(scene.views) == 22
    assert letters(scene, "test") == "aks", "every 8th of those that are there"
    assert "2 of 24 image files are missing" in caplog.text
    assert len(caplog.records) == 1


def test_dataset_without_images_is_refused(folder):
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"24 of 24 image files are missing: .*restore them$"):
        read_scene(folder, Split(missing="skip"))


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        ("holdout=-1", "expected a number, {every, offset}, {names: […]} or {file: …}, got -1"),
        ("holdout={every: 8, offset: 8}", "'offset' must be less than 'every', 8"),
        ("holdout={every:8,offset:4}", "or {file: …} (YAML needs a space after each colon)"),
        ("holdout={every: 8, offset: -1}", "expected an offset of 0 or more, got -1"),
        ("holdout={offset: 4}", "'offset' needs 'every', as in {every: 8, offset: 4}"),
        ("holdout={every: 8, names: [a]}", "expected a number, {every, offset}"),
        ("holdout={names: [42]}", "expected names of photos as strings: put numbers in quotes, as in '0042'"),
        ("holdout={names: [a, '']}", "expected names of photos, got an empty name"),
        ("train={names: [1.5]}", "put numbers in quotes, as in '0042', got 1.5"),
        ("validation=best", "or auto, got 'best'"),
        ("missing=ignore", "'refuse' or 'skip'"),
    ],
)
def test_invalid_selection_is_explained(setting, fault):
    with pytest.raises(ConfigError) as raised:
        load("splat_7k", [f"scene.{setting}"])
    assert fault in str(raised.value)


@pytest.mark.parametrize(
    ("count", "warned"), [(1, "only 1 photo for training"), (2, "only 2 photos for training"), (3, "")]
)
def test_fewer_than_three_photographs_give_a_warning_first(tiny_scene, caplog, count, warned):
    scene = read_scene(tiny_scene, Split(0))
    RunScene.from_scene(SceneSettings(path=str(tiny_scene)), replace(scene, train=scene.train[:count]))
    messages = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(messages) == bool(warned)
    assert all(warned in text for text in messages), messages


def test_every_nth_without_test_views_is_refused(folder):
    with pytest.raises(DataError, match=r"scene\.holdout selects 0 of 24 photos .* lower its offset, or set"):
        read_scene(folder, Split(ViewSelection(every=100, offset=99)))


def test_dry_run_without_test_views_omits_their_lines(folder, tmp_path):
    def described(holdout: int) -> str:
        return describe(
            load("splat_7k", [f"scene.path={folder}", f"scene.holdout={holdout}"]),
            RunState.read(tmp_path / "r"),
            None,
            "new",
        )

    assert "evaluate       1 test view at 1/1" in described(24)
    without = described(0)
    assert "  evaluate " not in without
    assert "  render" not in without
