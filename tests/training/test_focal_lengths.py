"""Focal lengths learned with poses: shared by the photographs of a camera, saved, measured, and written."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.api.commands import evaluate
from clsplat.core.errors import DataError
from clsplat.core.schedule import at_step
from clsplat.pipeline.loading import load
from clsplat.render.camera import camera_values, move_camera, upload_camera
from clsplat.render.workspace import Workspace
from clsplat.runs.model_file import write_cameras
from clsplat.scene.camera import Camera, Lens
from clsplat.scene.detect import read_scene
from clsplat.scene.view import DEGREES, View, photo_lens, zoom_lens
from clsplat.training.modules.base import attach_modules, learned_scene
from clsplat.training.modules.camera_optimizer import (
    CameraOptimizer,
    CameraState,
    require_zoom,
)
from tests.support.camera_rings import FISHEYE, STRONG
from tests.support.runs import FEW, digest, killed, train

ON = (*FEW, "optimize.modules.camera_optimizer={start: 2, focal: auto}")
PARAMS = {  # after focal lengths and middle
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.2,),
    "RADIAL": (-0.2, 0.05),
    "OPENCV": (-0.25, 0.06, 0.002, -0.001),
    "FULL_OPENCV": (-0.2, 0.05, 0.002, -0.001, 0.01, 0.03, -0.02, 0.01),
}


@pytest.mark.parametrize("model", DEGREES)
def test_lens_of_another_focal_length_undistorts_to_same_pixels(model):
    focals = (160.0,) if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else (160.0, 165.0)
    lens = Lens(200, 150, model, (*focals, 97.0, 80.0, *PARAMS[model]))
    other = zoom_lens(lens, 1.03)
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.5, 0.5, 7))
    for one, same in zip(lens.distort(u, v), other.distort(u / 1.03, v / 1.03), strict=True):
        np.testing.assert_allclose(same, one, rtol=0, atol=1e-10)
    assert (other.pinhole.width, other.pinhole.height) == (lens.pinhole.width, lens.pinhole.height)
    assert other.pinhole.cx == pytest.approx(lens.pinhole.cx)
    assert other.camera.fx == 1.03 * lens.camera.fx


def test_fisheye_focal_length_is_not_trained():
    assert zoom_lens(FISHEYE, 1.0) is FISHEYE
    with pytest.raises(DataError, match=r"focal length of the OPENCV_FISHEYE lens cannot be changed.*undistort"):
        zoom_lens(FISHEYE, 1.01)


def test_unwritable_focal_length_is_not_trained(tiny_scene):
    scene = read_scene(tiny_scene)
    with pytest.raises(DataError, match=r"camera_optimizer\.focal: the focal length of .*OPENCV_FISHEYE.*undistort"):
        require_zoom(replace(scene, views=(replace(scene.views[0], lens=FISHEYE),)))


def test_views_are_written_with_the_lens_of_their_focal_length(tmp_path):
    view = View("a.png", STRONG.pinhole, np.eye(3, 4), tmp_path / "a.png", lens=STRONG)
    assert photo_lens(view) is STRONG
    moved = replace(view, camera=view.camera.zoomed(1.02))
    assert photo_lens(moved).params == pytest.approx(zoom_lens(STRONG, 1.02).params)


def test_images_of_one_camera_share_a_parameter():
    first, other = Camera(64, 48, 50, 51, 32, 24), Camera(48, 64, 50, 51, 24, 32)
    views = [View(name, camera, np.eye(3, 4)) for name, camera in (("a", first), ("b", other), ("c", first))]
    views.append(View("d", first, np.eye(3, 4), lens=STRONG))
    state = CameraState(CameraOptimizer(focal=0.01), views, views)
    assert state.cameras == {"a": "a", "b": "b", "c": "a", "d": "d"}
    assert [state.factor(name) for name in "abcd"] == [1, 1, 1, 1]
    state.zoom("c", 5.0, 0.01)
    assert state.factor("a") == state.factor("c") == pytest.approx(np.exp(-0.01))
    assert [state.factor(name) for name in "bd"] == [1, 1]
    assert state.zoomed_cameras == ["a"]
    state.zoom("b", 5.0, 0.0)
    assert state.zoomed_cameras == ["a"]


def test_rates_follow_the_visits_of_a_camera():
    auto = CameraOptimizer(focal="auto")
    assert [at_step(auto.focal_rate(30_500, 1), step) for step in (0, 500, 30_500)] == pytest.approx([1e-4, 1e-4, 1e-6])
    seldom = auto.focal_rate(2500, 1)
    assert sum(at_step(seldom, step) for step in range(500, 2500)) == pytest.approx(0.2, rel=0.01)
    assert at_step(auto.focal_rate(600, 50), 0) == pytest.approx(1e-3), "at most"
    assert CameraOptimizer(focal=0.5).focal_rate(600, 50) == 0.5
    assert CameraOptimizer().focal_rate(600, 50) == 0.0
    assert load("smoke", ["optimize.modules.camera_optimizer={focal: auto}"]).settings.training.modules == [auto]


def test_device_camera_gets_its_rays_from_its_focal_length(device):
    view = View("a", Camera(70, 50, 60.0, 62.0, 33.0, 26.0), np.eye(3, 4))
    camera = move_camera(Workspace(device), upload_camera(device, view), view.world_to_camera, 1.02)
    expected = camera_values(replace(view, camera=view.camera.zoomed(1.02)), camera.tile)
    for name in expected.dtype.names or ():
        np.testing.assert_allclose(camera.values[name], expected[name], rtol=2e-7, err_msg=name)
    assert camera.array.get()[0] == camera.values


@pytest.fixture(scope="module")
def with_focals(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps in which focal lengths are learned; nothing is changed in it."""
    out = tmp_path_factory.mktemp("runs") / "focals"
    train(tiny_scene, out, *ON)
    return out


@pytest.mark.slow
def test_resumed_run_has_the_same_bits(with_focals, tiny_scene, tmp_path):
    out = killed(with_focals, tmp_path / "run")
    run = train(tiny_scene, out, *ON, resume=True)
    assert digest(out) == digest(with_focals)
    state = run.modules["camera_optimizer"]
    (key,) = [name for name in state.scalars if name.startswith("focal_lengths/") and name.endswith("/log")]
    assert state.scalars[f"{key}/updates"] == 12 - 2
    assert abs(state.scalars[key]) > 1e-4
    result = learned_scene(run)
    factors = [after.camera.fx / view.camera.fx for view, after in zip(run.original.views, result.views, strict=True)]
    assert factors == pytest.approx([np.exp(state.scalars[key])] * len(factors)), "also those of test views"
    (later,) = attach_modules([], run, 24)
    assert later.factor(run.original.views[0].name) != 1, "it stays"


@pytest.mark.slow
def test_metrics_and_files_use_the_learned_focal_lengths(with_focals, tiny_scene, tmp_path):
    measured = json.loads((with_focals / "metrics.json").read_text())["test"]["1"]
    assert evaluate(with_focals)["test"]["1"]["psnr"] == pytest.approx(measured["psnr"], abs=1e-6)
    rows = json.loads((with_focals / "view_poses.json").read_text())["photographs"]
    (lengths,) = {tuple(row["focal_lengths"]) for row in rows.values()}
    scene = read_scene(tiny_scene, 5)
    assert lengths[0] != scene.views[0].camera.fx
    assert CameraOptimizer.apply_side_files(with_focals / "point_cloud.ply", scene).views[0].camera.fx == lengths[0]
    write_cameras(with_focals, tmp_path / "cameras", "nerfstudio", "copy")
    for view in read_scene(tmp_path / "cameras", 5).views:
        assert (view.camera.fx, view.camera.fy) == pytest.approx(lengths)
    for row in ({"focal_lengths": [1]}, {"focal_lengths": [1, -1]}, {"focal_lengths": [1e300, 60]}, []):
        broken = {name: row for name in rows}
        (tmp_path / "view_poses.json").write_text(json.dumps({"photographs": broken}))
        with pytest.raises(DataError, match=r"view_poses.json: .*no focal lengths within 10 times"):
            CameraOptimizer.apply_side_files(tmp_path / "point_cloud.ply", scene)


@pytest.mark.slow
def test_training_only_poses_writes_the_same_files(with_focals, tiny_scene, tmp_path):
    train(tiny_scene, tmp_path / "run", *FEW, "optimize.modules.camera_optimizer={start: 2}")
    assert digest(tmp_path / "run") != digest(with_focals)
    assert "focal_lengths" not in (tmp_path / "run" / "view_poses.json").read_text()
