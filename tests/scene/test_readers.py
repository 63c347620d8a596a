"""The list of dataset readers: shipped and from plug-ins."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.prepare.inspect.findings import Inspection
from clsplat.scene import Camera, PointCloud, Reader, Scene, View, make_scene
from clsplat.scene.colmap import ColmapReader
from clsplat.scene.detect import find_datasets, format_names, is_scene, read_scene, readers
from tests.support.orbit_scene import orbit, photograph, write
from tests.support.refusals import refusal

SHIPPED = ["multi-camera video", "COLMAP", "Blender", "multi-scale Blender", "nerfstudio", "LLFF"]


@pytest.fixture(autouse=True)
def _forget_readers() -> Iterator[None]:
    defined = list(Reader.subclasses)
    yield
    Reader.subclasses[:] = defined


class OneFile(Reader):
    """Of the tests below: a base class that is abstract."""

    def matches(self, path: Path) -> bool:
        return (path / self.expects).is_file()


def test_shipped_readers_come_in_order_of_precedence():
    assert [reader.name for reader in readers()] == SHIPPED
    assert format_names() == "multi-camera video, COLMAP, Blender, multi-scale Blender, nerfstudio or LLFF"


def test_readers_of_plugins_follow_in_order_of_definition():
    class Second(OneFile):
        name, expects = "second", "b"

        def read(self, path: Path, holdout: int) -> Scene:
            raise AssertionError

    class First(Second):  # takes the place of the class that it extends
        name = "first"

    class Third(First):
        name = "third"

    class Other(OneFile):
        name, expects = "other", "c"
        read = Second.read

    assert [reader.name for reader in readers()] == [*SHIPPED, "third", "other"]


def test_derived_reader_replaces_its_shipped_base():
    class Wider(ColmapReader):
        name = "wider"

    assert [reader.name for reader in readers()] == [SHIPPED[0], "wider", *SHIPPED[2:]]


def test_redefined_reader_replaces_the_previous():
    def define() -> type[Reader]:
        class Own(OneFile):
            name, expects = "own", "o"
            read = ColmapReader.read

        return Own

    first, second = define(), define()
    assert first is not second
    assert [type(reader) for reader in readers()][len(SHIPPED) :] == [second]


def test_reader_without_a_name_is_refused(tmp_path):
    class Nameless(OneFile):
        def read(self, path: Path, holdout: int) -> Scene:
            raise AssertionError

    with pytest.raises(ConfigError, match="Nameless has no name and no expects; add it to the class"):
        read_scene(tmp_path)


@pytest.fixture
def grid(tmp_path: Path) -> Path:
    """A folder of four photographs for the reader of the next tests only."""
    for i in range(4):
        photograph(tmp_path / f"{i}.png")
    (tmp_path / "grid.txt").write_text("4")
    return tmp_path


def test_reader_needs_only_matches_and_read_for_inspection(grid):
    assert not is_scene(grid)

    class Grid(OneFile):
        name, expects = "grid", "grid.txt"

        def read(self, path: Path, holdout: int) -> Scene:
            if not (path / "grid.txt").read_text():
                raise DataError(f"{path / 'grid.txt'}: is empty; write the number of photos")
            poses = np.stack([np.eye(3, 4)] * 4)
            poses[:, 0, 3] = range(4)
            camera = Camera(64, 48, 60, 60, 32, 24)
            views = [View(f"{i}.png", camera, pose, path / f"{i}.png") for i, pose in enumerate(poses)]
            cloud = PointCloud(np.float32([[0, 0, 5], [1, 0, 5]]), np.float32([[1, 0, 0.2], [0, 0, 0]]))
            return make_scene(path, views, {0}, cloud)

    assert is_scene(grid)
    inspection = Inspection.from_folder(grid)
    facts, parts = inspection.facts, inspection.parts
    assert inspection.is_trainable
    assert (facts.kind, facts.registered, facts.on_disk, facts.train, facts.test) == ("grid", 4, 4, 3, 1)
    assert (facts.points.count, facts.points.error_mean) == (2, None)
    assert parts.points.rgb.tolist() == [[255, 0, 51], [0, 0, 0]]
    (grid / "3.png").unlink()
    assert Inspection.from_folder(grid).facts.missing == ["3.png"]
    (grid / "grid.txt").write_text("")
    inspection = Inspection.from_folder(grid)
    assert (inspection.facts.kind, inspection.facts.registered) == ("grid", 0)
    assert "grid.txt: is empty" in inspection.verdict


def test_unknown_folder_error_lists_every_reader(tmp_path):
    message = refusal(read_scene, tmp_path)
    assert all(f"{reader.name} ({reader.expects})" in message for reader in readers())


def test_first_matching_reader_is_used(tmp_path):
    path = write(tmp_path / "scene", orbit())
    (path / "transforms.json").write_text("damaged")
    assert len(read_scene(path).views) == 24
    assert Inspection.from_folder(path).facts.kind == "COLMAP"


@pytest.mark.parametrize("changes", [{"width": 0}, {"fx": -1.0}, {"fy": float("nan")}, {"cx": float("inf")}])
def test_impossible_camera_is_refused_from_any_reader(tmp_path, changes):
    camera = Camera(**{"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0, **changes})
    view = View("a.png", camera, np.eye(3, 4), tmp_path / "a.png")
    assert "'a.png': the camera is" in refusal(make_scene, tmp_path, [view], set(), None)


@pytest.mark.parametrize("pose", [np.zeros((3, 4)), np.full((3, 4), np.nan), np.eye(4)])
def test_invalid_pose_is_a_data_error_from_any_reader(pose):
    assert "the pose of 'a.png'" in refusal(View, "a.png", Camera(64, 48, 60.0, 60.0, 32.0, 24.0), pose)


def test_deep_dataset_is_found_if_there_is_no_other(tmp_path):
    for folder in ("a/b/c", "a/b/c/d/e"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "transforms.json").write_text("{}")
    assert [reader.folder for reader in find_datasets(tmp_path)] == [tmp_path / "a" / "b" / "c"]
    (tmp_path / "z").mkdir()
    (tmp_path / "z" / "transforms.json").write_text("{}")
    assert [reader.folder for reader in find_datasets(tmp_path)] == [tmp_path / "z"]
