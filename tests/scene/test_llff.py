"""LLFF datasets: poses_bounds.npy next to photographs."""

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.scene.camera import Camera
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.llff import POSES_FILE, LlffReader
from clsplat.scene.transforms_json import NerfstudioReader
from clsplat.scene.view import View
from tests.support.data_sets import data_set

SIZE = (8, 6)  # px, of the images on disk; the file has twice that


def write_scene(folder, views, images=None):
    """An LLFF dataset of some views, with black images."""
    (folder / "images").mkdir()
    rows = []
    for view in views:
        rotation = view.world_to_camera[:, :3].T
        axes = rotation[:, [1, 0]], -rotation[:, 2:], view.position[:, None], [[12.0], [16.0], [20.0]]
        rows.append([*np.hstack(axes).ravel(), 1.0, 9.0])
    np.save(folder / POSES_FILE, np.array(rows))
    for view in views[:images]:
        write_image(folder / "images" / view.name, np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    return folder


@pytest.fixture
def views():
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
    places = [(1, 2, 3), (-2, 0.5, 1), (0.1, -3, 2)]
    return [View.looking_at(place, (0, 0, 0), (0, 0, 1), camera, f"{i}.png") for i, place in enumerate(places)]


def test_poses_and_scaled_focal_length(tmp_path, views):
    scene = read_scene(write_scene(tmp_path, views), holdout=3)
    assert [view.name for view in scene.views] == ["0.png", "1.png", "2.png"]
    for view, expected in zip(scene.views, views, strict=True):
        np.testing.assert_allclose(view.world_to_camera, expected.world_to_camera, atol=1e-12)
        camera = view.camera
        assert (camera.width, camera.height, camera.fx, camera.cx) == (8, 6, 10.0, 4.0)
    assert scene.test == (0,)
    assert scene.points is None


def test_number_of_images_must_match(tmp_path, views):
    write_scene(tmp_path, views, images=2)
    with pytest.raises(DataError, match="3 poses for 2 images"):
        read_scene(tmp_path)


@pytest.mark.parametrize("rows", [np.zeros((2, 15)), np.full((2, 17), np.nan), np.array([{}])])
def test_damaged_file_is_a_data_error(tmp_path, views, rows):
    write_scene(tmp_path, views)
    np.save(tmp_path / POSES_FILE, rows, allow_pickle=True)
    with pytest.raises(DataError, match="export it again"):
        read_scene(tmp_path)


def test_real_scene_agrees_with_its_transforms_json():
    path = data_set("juice")
    by_name = {view.image_path.name: view for view in NerfstudioReader().read(path, 8).views}
    for view in LlffReader().read(path, 8).views:
        np.testing.assert_allclose(view.world_to_camera, by_name[view.name].world_to_camera, atol=1e-9)
