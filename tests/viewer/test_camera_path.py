"""nerfstudio's camera_path.json: reading, transforming back, and refusal of damaged files."""

import json
import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.core.errors import DataError
from clsplat.scene import camera_files
from clsplat.scene.camera import Camera
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.viewer.video import camera_path
from clsplat.viewer.video.paths import PATHS
from tests.support.camera_paths import write_camera_path
from tests.support.camera_rings import SIZE, rig_of, ring


@pytest.fixture
def views(rng):
    return PATHS["ellipse"](rig_of(ring(np.linspace(0, 6, 20)), rng), 12, SIZE)


def poses(views):
    return np.stack([view.world_to_camera for view in views])


def test_path_round_trip(views, tmp_path):
    write_camera_path(tmp_path / "p.json", views, 24)
    result = camera_path.read(tmp_path / "p.json")
    assert (result.fps, result.size) == (24, SIZE)
    np.testing.assert_allclose(poses(result.views), poses(views), atol=1e-12)
    for old, new in zip(views, result.views, strict=True):
        np.testing.assert_allclose(
            [new.camera.fx, new.camera.fy, new.camera.cx], [old.camera.fy, old.camera.fy, 32], rtol=1e-12
        )


def test_nerfstudio_path_is_transformed_back(views, tmp_path, rng):
    turn, shift, scale = Rotation.random(random_state=3).as_matrix(), rng.normal(size=3), 0.37
    write_camera_path(tmp_path / "p.json", views, 24)
    data = json.loads((tmp_path / "p.json").read_text())
    for frame in data["camera_path"]:
        matrix = np.array(frame["camera_to_world"]).reshape(4, 4)
        matrix[:3, :3], matrix[:3, 3] = turn @ matrix[:3, :3], scale * (turn @ matrix[:3, 3] + shift)
        frame["camera_to_world"] = matrix.ravel().tolist()
    (tmp_path / "p.json").write_text(json.dumps(data))
    world = {"transform": np.column_stack([turn, shift]).tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(world))
    np.testing.assert_allclose(poses(camera_path.read(tmp_path / "p.json").views), poses(views), atol=1e-12)


def test_nerfstudios_transform_of_poses_applies_to_the_path(views, tmp_path):
    """nerfstudio tells the move from the world of COLMAP; poses of transforms.json have one of their own."""
    write_camera_path(tmp_path / "p.json", views, 24)
    applied = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]])
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(3, 4).tolist(), "scale": 1}))
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps({"applied_transform": applied.tolist()}))
    actual = camera_path.read(tmp_path / "p.json", tmp_path / "scene").views
    for old, new in zip(views, actual, strict=True):
        np.testing.assert_allclose(new.position, applied[:, :3] @ old.position + applied[:, 3], atol=1e-12)
        np.testing.assert_allclose(new.world_to_camera[2, :3], applied[:, :3] @ old.world_to_camera[2, :3], atol=1e-12)


def test_possibly_transformed_path_gives_a_warning(views, tmp_path, caplog):
    write_camera_path(tmp_path / "p.json", views, 24)
    with caplog.at_level(logging.WARNING, "clsplat"):
        camera_path.read(tmp_path / "p.json")
    assert "put dataparser_transforms.json next to this file" in caplog.text


def test_path_is_resampled_to_other_frame_counts(views):
    many = camera_path.resample(views, 23)
    np.testing.assert_allclose(poses(many)[::2], poses(views), atol=1e-12)
    between = (views[0].position + views[1].position) / 2
    np.testing.assert_allclose(many[1].position, between, atol=1e-12)
    assert len(camera_path.resample(views[:1], 4)) == 4
    assert camera_path.resample(views, 12) == views
    assert len(camera_path.resample(views, 1)) == 1


def test_another_size_keeps_the_vertical_field_of_view(views, tmp_path):
    write_camera_path(tmp_path / "p.json", views, 24)
    wide = camera_path.read(tmp_path / "p.json").resized((200, 96))[0].camera
    assert wide.fy == pytest.approx(2 * views[0].camera.fy)
    assert (wide.width, wide.cx, wide.cy) == (200, 100, 48)


@pytest.fixture
def oblique(tmp_path):
    """A cameras.json with two lenses off the middle, and its path."""
    cameras = [Camera(640, 480, 500.0, 400.0, cx, 200.0) for cx in (300.0, 350.0)]
    views = [View(f"{i}.png", camera, np.eye(3, 4)) for i, camera in enumerate(cameras)]
    camera_files.write_inria(tmp_path, Scene.from_views(views))
    return camera_path.read(tmp_path / "cameras.json")


def lenses(views):
    return [(c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in views)]


def test_another_size_keeps_the_lens(oblique):
    assert (
        lenses(oblique.resized(oblique.size)) == lenses(oblique.views) == [(500, 400, 300, 200), (500, 400, 350, 200)]
    )
    assert lenses(oblique.resized((640, 240))) == [(250, 200, 310, 100), (250, 200, 335, 100)]


def test_lens_is_interpolated_between_views(oblique):
    assert lenses(camera_path.resample(oblique.views, 3)) == [(500, 400, cx, 200) for cx in (300, 325, 350)]


FAULTS = {
    "not a path": (lambda d: d.pop("camera_path"), "a list `camera_path`"),
    "no frames": (lambda d: d.update(camera_path=[]), "has 0 frames"),
    "a fisheye": (lambda d: d.update(camera_type="fisheye"), "expected perspective"),
    "no angle": (lambda d: d["camera_path"][1].pop("fov"), "camera_path\\[1\\]: fov is None"),
    "a wide angle": (lambda d: d["camera_path"][0].update(fov=180), "fov is 180"),
    "no width at all": (lambda d: d["camera_path"][0].update(fov=1e-322), "fov is 1e-322"),
    "text": (lambda d: d["camera_path"][0].update(fov="wide"), "fov is 'wide'"),
    "few numbers": (lambda d: d["camera_path"][2]["camera_to_world"].pop(), "camera_path\\[2\\]"),
    "no rotation": (lambda d: d["camera_path"][0].update(camera_to_world=[0.0] * 16), "rotation"),
    "huge": (lambda d: d.update(render_width=10**9), "size"),
    "no height": (lambda d: d.update(render_height=0), r"size \(64, 0\).*; export the path again"),
    "a width alone": (lambda d: d.pop("render_height"), r"size \(64, 0\)"),
    "no size": (lambda d: d.update(render_width=0, render_height=0), r"size \(0, 0\)"),
    "a rate": (lambda d: d.update(fps=100000), "frames per second.*; export the path again"),
    "no rate": (lambda d: d.update(fps=0), "fps 0.0"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damaged_paths_are_refused_in_one_line(fault, views, tmp_path):
    write_camera_path(tmp_path / "p.json", views, 24)
    data = json.loads((tmp_path / "p.json").read_text())
    change, message = FAULTS[fault]
    change(data)
    (tmp_path / "p.json").write_text(json.dumps(data))
    with pytest.raises(DataError, match=message) as raised:
        camera_path.read(tmp_path / "p.json")
    assert str(raised.value).startswith(f"{tmp_path / 'p.json'}: ")


@pytest.mark.parametrize("world", [{}, {"transform": [[1, 0, 0, 0]], "scale": 1}, {"scale": 0}, [], {"transform": "x"}])
def test_damaged_dataparser_transform_is_refused(world, views, tmp_path):
    write_camera_path(tmp_path / "p.json", views, 24)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(world))
    with pytest.raises(DataError, match="export the file again"):
        camera_path.read(tmp_path / "p.json")
