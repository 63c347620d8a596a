"""Scenes in world coordinates: a float64 origin, subtracted from all positions and restored in files."""

import numpy as np
import pytest

from clsplat.scene.camera_files import write_cameras
from clsplat.scene.detect import read_scene
from tests.support.data_sets import data_set
from tests.support.transforms_scene import SHIFTED_POINTS, write_shifted

UTM = np.array([500_000.0, 4_500_000.0, 30.0])


def test_shifted_scene_equals_its_local_twin(tmp_path):
    local, moved = (
        write_shifted(tmp_path / "local"),
        write_shifted(tmp_path / "moved", np.array([500_000, 4_500_000, 0])),
    )
    np.testing.assert_array_equal(local.origin, 0)
    np.testing.assert_array_equal(moved.origin, [500_000, 4_500_000, 0])
    for one, other in zip(local.views, moved.views, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)
    np.testing.assert_array_equal(local.points.positions, moved.points.positions)
    assert moved.points.positions.dtype == np.float32
    assert local.extent == moved.extent


@pytest.mark.parametrize("format_", ["colmap", "nerfstudio"])
def test_exported_cameras_are_in_world_coordinates(tmp_path, format_):
    scene = write_shifted(tmp_path / "scene", UTM)
    write_cameras(scene, tmp_path / "out", format_, images="copy")
    again = read_scene(tmp_path / "out", holdout=0)
    np.testing.assert_array_equal(again.origin, scene.origin)
    for one, other in zip(scene.views, again.views, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-8)
    np.testing.assert_allclose(again.points.positions + again.origin, SHIFTED_POINTS + UTM, atol=1e-6)


def test_utm_scene_of_colmap():
    scene = read_scene(data_set("cases") / "utm_scene")
    np.testing.assert_array_equal(scene.origin, [500_000, 4_500_000, 100])
    assert np.abs(scene.points.positions).max() < 10
    world = scene.in_world()
    np.testing.assert_allclose(world.views[0].position, scene.views[0].position + scene.origin, atol=1e-6)
