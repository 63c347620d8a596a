"""Damaged camera paths and lists of cameras are read or refused, quickly and with little memory."""

import json

import numpy as np
import pytest

from clsplat.scene import camera_files
from clsplat.scene.control import read_control
from clsplat.scene.scene import make_scene
from clsplat.viewer.video import camera_path
from clsplat.viewer.video.paths import MAX_FRAMES, SIDES
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome
from tests.support.camera_paths import write_camera_path
from tests.support.camera_rings import ring

VIEWS = ring(np.linspace(0, 2, 3))
WORLD = {"transform": np.eye(3, 4).tolist(), "scale": 0.5}
WORDS = ['"camera_path"', '"camera_to_world"', '"fov"', '"fisheye"', "179.9", '"render_width"', '"fps"', '"rotation"']


@pytest.fixture(scope="module")
def seeds(folder):
    write_camera_path(folder / "a.json", VIEWS, 24)
    camera_files.write_inria(folder, make_scene(folder, VIEWS, set(), None))
    moved = json.loads((folder / "a.json").read_text())
    del moved["seconds"]
    return [(folder / "a.json").read_bytes(), (folder / "cameras.json").read_bytes(), json.dumps(moved).encode()]


def test_damaged_path_is_read_or_refused(seeds, folder):
    @fuzzed(80, data=damaged(seeds, WORDS))
    def reads(data):
        (folder / "b.json").write_bytes(data)
        actual = outcome(camera_path.read, folder / "b.json")
        outcome(camera_files.read_inria, folder / "b.json")
        if actual is not None:
            assert 1 <= len(actual.views) <= MAX_FRAMES
            assert all(view.camera.check() and max(actual.size) <= SIDES[1] for view in actual.views)
            assert all(view.name == f"frame_{i:05d}" for i, view in enumerate(actual.views, 1))

    reads()


def test_damaged_control_points_are_read_or_refused(folder):
    text = "point,x,y,z,photo,u,v\na,1,2,3,p.png,4,5\na,,,,q.png,6,7\nb,1e3,-2,3,p.png,4,5\n"

    @fuzzed(80, data=damaged([text.encode()], [",", '"', "nan", "1e99", "\n", "photo"]))
    def reads(data):
        (folder / "points.csv").write_bytes(data)
        for point in (outcome(read_control, folder / "points.csv") or {}).values():
            assert np.isfinite(
                [*(point.coordinates or ()), *(value for mark in point.marks for value in mark.pixel)]
            ).all()

    reads()


def test_damaged_move_is_read_or_refused(seeds, folder):
    (folder / "own").mkdir()
    (folder / "own" / "a.json").write_bytes(seeds[2])

    @fuzzed(40, data=damaged([json.dumps(WORLD).encode()], ['"scale"', '"transform"']))
    def reads(data):
        (folder / "own" / camera_path.WORLD).write_bytes(data)
        outcome(camera_path.read, folder / "own" / "a.json")

    reads()
