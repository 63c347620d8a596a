"""Scenes in world coordinates: one origin in float64, subtracted from all positions and given back in files."""

import json

import numpy as np
import pytest

from clsplat.scene.camera_files import write_cameras
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud
from clsplat.scene.transforms_json import opengl_matrix
from clsplat.scene.view import View
from tests.support.data_sets import data_set
from tests.support.transforms_scene import LENS

UTM = np.array([500_000.0, 4_500_000.0, 30.0])
CENTERS = np.array([[1.25, 0, 2], [-2, 0.5, 1], [0.25, -3, 2], [2, 2, -1.5]])
POINTS = np.array([[0.125, 0.25, -0.5], [0.5, -0.5, 0.25], [0, 0, 0]])


def write_scene(folder, shift=0.0):
    """A nerfstudio dataset whose coordinates are all moved by `shift`."""
    frames = []
    for i, center in enumerate(CENTERS):
        matrix = opengl_matrix(View.looking_at(center, (0, 0, 0), (0, 0, 1), None).world_to_camera)
        matrix[:3, 3] = center + shift
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix.tolist()})
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_image(folder / "images" / f"{i}.png", np.full((48, 64, 3), 50 * i, np.uint8))
    (folder / "transforms.json").write_text(json.dumps(LENS | {"frames": frames, "ply_file_path": "p.ply"}))
    write_points_ply(folder / "p.ply", PointCloud(POINTS + shift, np.full((3, 3), 0.5)))
    return read_scene(folder, holdout=0)


def test_shifted_scene_equals_its_local_twin(tmp_path):
    local, moved = write_scene(tmp_path / "local"), write_scene(tmp_path / "moved", np.array([500_000, 4_500_000, 0]))
    np.testing.assert_array_equal(local.origin, 0)
    np.testing.assert_array_equal(moved.origin, [500_000, 4_500_000, 0])
    for one, other in zip(local.views, moved.views, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)
    np.testing.assert_array_equal(local.points.positions, moved.points.positions)
    assert moved.points.positions.dtype == np.float32
    assert local.extent == moved.extent


@pytest.mark.parametrize("format_", ["colmap", "nerfstudio"])
def test_exported_cameras_are_in_world_coordinates(tmp_path, format_):
    scene = write_scene(tmp_path / "scene", UTM)
    write_cameras(scene, tmp_path / "out", format_, images="copy")
    again = read_scene(tmp_path / "out", holdout=0)
    np.testing.assert_array_equal(again.origin, scene.origin)
    for one, other in zip(scene.views, again.views, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-8)
    np.testing.assert_allclose(again.points.positions + again.origin, POINTS + UTM, atol=1e-6)


def test_utm_scene_of_colmap():
    scene = read_scene(data_set("cases") / "utm_scene")
    np.testing.assert_array_equal(scene.origin, [500_000, 4_500_000, 100])
    assert np.abs(scene.points.positions).max() < 10
    world = scene.in_world()
    np.testing.assert_allclose(world.views[0].position, scene.views[0].position + scene.origin, atol=1e-6)
