"""Camera models against pycolmap's projections, and undistorted photographs against the lens."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.scene import camera as lens_room
from clsplat.scene.camera import MAX_ITERATIONS, MODELS, WIDE, Lens, intern_lens
from tests.support.camera_rings import FISHEYE, STRONG
from tests.support.data_sets import data_set


def test_every_model_projects_like_colmap():
    """Worst error 0.01 px, for a field-of-view lens so weak that COLMAP takes a series; the others 1e-12."""
    cases = json.loads((data_set("colmap_models") / "projection_oracle.json").read_text())
    assert {case["model"] for case in cases.values()} >= set(MODELS) - WIDE, "test_panoramas has those of WIDE"
    for name, case in cases.items():
        lens = Lens(case["width"], case["height"], case["model"], tuple(case["params"]))
        pixels = np.array(case["pixels"])
        error = np.abs(lens.project(np.array(case["points_cam"])) - pixels).max()
        assert error < (0.02 if name == "FOV_fitted" else 1e-9), name
        back = np.stack(lens.undistort(*pixels.T), axis=1)
        np.testing.assert_allclose(back, case["normalized_back"], atol=1e-8, err_msg=name)


@pytest.mark.parametrize("lens", [STRONG, FISHEYE])
def test_converged_pixels_match_the_full_iteration(lens):
    """Beyond the photograph some never settle, and some become infinite."""
    x, y = np.meshgrid(np.linspace(-40, lens.width + 40, 97), np.linspace(-40, lens.height + 40, 71))
    fx, fy, cx, cy, rest = lens._intrinsics
    goal = np.stack([(x.ravel() - cx) / fx, (y.ravel() - cy) / fy])
    actual = goal
    with np.errstate(all="ignore"):
        for _ in range(MAX_ITERATIONS):
            actual = lens_room._newton_step(MODELS[lens.model][1], rest, actual, goal)
    u, v = (item.ravel() for item in lens.undistort(x, y))
    good = np.isfinite(u)
    assert good.mean() > 0.5
    assert np.stack([u, v])[:, good].tobytes() == actual[:, good].tobytes()


def test_photographs_of_one_camera_share_one_map(monkeypatch):
    drawn: list[np.ndarray] = []
    computed: list[int] = []
    remap, distort = cv2.remap, Lens.distort
    monkeypatch.setattr(lens_room.cv2, "remap", lambda *a, **k: (drawn.append(a[1]), remap(*a, **k))[1])
    monkeypatch.setattr(Lens, "distort", lambda self, u, v: (computed.append(u.size), distort(self, u, v))[1])
    photograph = np.zeros((STRONG.height, STRONG.width, 3), np.uint8)
    for _ in range(3):
        first = intern_lens(
            replace(STRONG, params=(161.0, *STRONG.params[1:]), keep_border=True)
        )  # a lens of this test alone
        first.undistort_image(photograph)
        assert first.visible_pixels.any()
    assert drawn[0] is drawn[1] is drawn[2]
    assert len(computed) == 2  # the map, and the pixels that are shown


@pytest.mark.parametrize("lens", [STRONG, FISHEYE])
def test_undistorted_photographs_agree_with_the_lens(lens):
    """A photograph of directions: what a pixel of the pinhole shows is its own ray, to 0.1 px at the corners."""
    y, x = np.meshgrid(np.arange(lens.height) + 0.5, np.arange(lens.width) + 0.5, indexing="ij")
    u, v = lens.undistort(x.ravel(), y.ravel())
    photograph = np.stack([u, v, np.zeros_like(u)], axis=1).reshape(lens.height, lens.width, 3).astype(np.float32)
    camera = lens.pinhole
    shown = lens.undistort_image(photograph)
    rows, columns = np.array([0, 0, -1, -1, 40]), np.array([0, -1, 0, -1, 50])
    px = (np.arange(camera.width) + 0.5)[columns]
    py = (np.arange(camera.height) + 0.5)[rows]
    seen = shown[rows, columns, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    np.testing.assert_allclose(seen, np.stack([px, py], axis=1), atol=0.1)


@pytest.mark.parametrize("lens", [STRONG, FISHEYE])
def test_wide_pinhole_covers_the_whole_image(lens):
    """Every ray within 60 degrees and twice the size is in the wide pinhole; it shows what its mask says, to 0.1 px."""
    lens = replace(lens, keep_border=True)
    y, x = np.meshgrid(np.arange(lens.height) + 0.5, np.arange(lens.width) + 0.5, indexing="ij")
    u, v = lens.undistort(x, y)
    camera = lens.pinhole
    columns, rows = u * camera.fx + camera.cx, v * camera.fy + camera.cy
    near = (np.maximum(np.abs(u), np.abs(v)) < 3**0.5) & (np.abs(u) < 200 / camera.fx) & (np.abs(v) < 150 / camera.fy)
    assert columns[near].min() > -1
    assert rows[near].min() > -1
    assert columns[near].max() < camera.width + 1
    assert rows[near].max() < camera.height + 1
    seen = lens.undistort_image(np.stack([u, v, v], axis=2).astype(np.float32))
    py, px = np.nonzero(lens.visible_pixels)
    assert 0.5 < lens.visible_pixels.mean() < 1
    inner = (py % 7 == 0) | (px % 7 == 0)
    py, px = py[inner], px[inner]
    actual = seen[py, px, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    error = np.abs(actual - np.stack([px + 0.5, py + 0.5], axis=1)).max(axis=1)
    x, y = lens.distort((px + 0.5 - camera.cx) / camera.fx, (py + 0.5 - camera.cy) / camera.fy)
    is_inner = (x > 0.5) & (y > 0.5) & (x < lens.width - 0.5) & (y < lens.height - 0.5)  # not on the last half pixel
    assert error[is_inner].max() < 0.1


@pytest.mark.parametrize("lens", [STRONG, FISHEYE])
def test_no_pixel_of_the_pinhole_is_blank(lens):
    camera = lens.pinhole
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    u, v = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    x, y = lens.distort(u, v)
    assert x.min() > -0.5
    assert y.min() > -0.5
    assert x.max() < lens.width + 0.5
    assert y.max() < lens.height + 0.5


def test_undistorted_lens_changes_nothing(rng):
    lens = Lens(40, 30, "OPENCV", (50.0, 51.0, 19.0, 16.0, 0.0, 0.0, 0.0, 0.0))
    assert not lens.has_distortion
    assert (lens.pinhole.width, lens.pinhole.height) in [(40, 30), (39, 29), (40, 29), (39, 30)]
    assert FISHEYE.has_distortion


def test_non_invertible_lens_is_refused():
    with pytest.raises(DataError, match="calibrate the camera again"):
        _ = Lens(100, 100, "SIMPLE_RADIAL", (1.0, 50.0, 50.0, -9.0)).pinhole
