"""The plane sweep finds surfaces: a textured wall, a ray-cast table, and structure-from-motion points."""

import re
import shutil
from dataclasses import replace
from math import cos, sin, tan
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.core.errors import DataError
from clsplat.data_tools.casting import camera_pose
from clsplat.data_tools.synthetic import CAMERA_DISTANCE, LOOK_AT, STILL_LIFE
from clsplat.scene.camera import Camera
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.plane_sweep import MAX_DEPTH, MIN_DEPTH, PLANES, Surface, sweep_points
from clsplat.scene.quality import opaque_pixels
from clsplat.scene.scene import PointCloud
from clsplat.scene.view import View, load_image
from clsplat.scene.viewpoint import scene_center
from clsplat.stages.init import Init
from tests.support.data_sets import data_set
from tests.support.runs import train

pytestmark = pytest.mark.slow

DEPTH = 4.0
SIDE = 96  # px of the ray-cast photographs


def wall_views(rng, count=6):
    """Views of a wall z = 4 with smooth noise on it, and their photographs by name."""
    texture = cv2.GaussianBlur(rng.random((400, 400, 3)).astype(np.float32), (0, 0), 3)
    texture = (texture - texture.min()) / np.ptp(texture) * 255
    camera = Camera(120, 90, 100, 100, 60, 45)
    views, photographs = [], {}
    for i in range(count):
        center = np.array([0.25 * i - 0.6, 0.1 * (i % 2), 0])
        views.append(View(str(i), camera, np.column_stack([np.eye(3), -center]), Path("none")))
        columns, rows = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
        x, y = (columns - 60) / 100 * DEPTH + center[0], (rows - 45) / 100 * DEPTH + center[1]
        maps = (200 + 50 * x).astype(np.float32), (200 + 50 * y).astype(np.float32)
        photographs[str(i)] = cv2.remap(texture, *maps, cv2.INTER_LINEAR).astype(np.uint8)
    return views, photographs


def test_wall_is_found_at_its_depth(rng):
    views, photographs = wall_views(rng)
    points = sweep_points(views, np.array([0, 0, DEPTH]), lambda view: photographs[view.name], 5000, 0)
    assert len(points) == 5000
    depth = points.positions[:, 2]
    assert np.mean(np.abs(depth - DEPTH) < 0.05 * DEPTH) > 0.95
    row = (45 + 100 * (points.positions[:, 1] - 0) / depth).astype(int)  # seen by the view at (-0.1, 0, 0)
    column = (60 + 100 * (points.positions[:, 0] + 0.1) / depth).astype(int)
    seen = (row >= 0) & (row < 90) & (column >= 0) & (column < 120)
    difference = np.abs(points.colors[seen] * 255 - photographs["2"][row[seen], column[seen]])
    assert np.median(difference) < 12


def test_swept_points_are_reproducible(rng):
    views, photographs = wall_views(rng, 3)
    first, second = (sweep_points(views, np.array([0, 0, 4.0]), lambda v: photographs[v.name], 700, 3) for _ in "ab")
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.colors, second.colors)


def test_unrelated_images_give_few_points(rng):
    views, photographs = wall_views(rng)
    noise = {name: rng.integers(0, 256, image.shape).astype(np.uint8) for name, image in photographs.items()}
    assert len(sweep_points(views, np.array([0, 0, 4.0]), lambda view: noise[view.name], 5000, 0)) < 2500
    assert len(sweep_points(views[:1], np.array([0, 0, 4.0]), lambda view: noise[view.name], 5000, 0)) == 0


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Views of the still life, [H, W, 4] photographs on disk, and exact depths by name, [H, W]; infinite: the sky."""
    folder, world = tmp_path_factory.mktemp("table"), replace(STILL_LIFE, grid=2)
    focal = 0.5 * SIDE / tan(0.5 * world.camera_angle_x)
    camera, views, depths = Camera(SIDE, SIDE, focal, focal, SIDE / 2, SIDE / 2), [], {}
    for i in range(5):
        around, up = 0.12 * i, 0.35 + 0.06 * (i % 2)
        backward = np.array([cos(around) * cos(up), sin(around) * cos(up), sin(up)])
        pose = camera_pose(LOOK_AT + CAMERA_DISTANCE * backward, backward)
        write_image(folder / f"{i}.png", world.photograph(pose, SIDE))
        flipped = np.linalg.inv(pose @ np.diag([1, -1, -1, 1]))[:3]
        views.append(View(str(i), camera, flipped, folder / f"{i}.png"))
        y, x = np.indices((SIDE, SIDE)).reshape(2, -1) + 0.5
        origin, directions = world.camera_rays(pose, SIDE, x, y)
        depths[str(i)] = (world.trace(origin, directions)[0] * -(pose[:3, 2] @ directions)).reshape(SIDE, SIDE)
    return views, depths


def before_a_sky(view):
    return load_image(view, (0.55, 0.7, 0.9))


def swept(table, shown):
    return sweep_points(table[0], LOOK_AT, before_a_sky, 50_000, 0, load_mask=shown)


def test_pixels_are_placed_at_exact_depths(table):
    """The median error is below half of the distance between planes, in inverse depth."""
    views, depths = table
    points = swept(table, lambda view: np.isfinite(depths[view.name]) & (view.name == "2"))
    assert len(points) > 500
    place = points.positions @ views[2].world_to_camera[:, :3].T + views[2].world_to_camera[:, 3]
    column, row = np.floor(place[:, :2] / place[:, 2:] * views[2].camera.fx + SIDE / 2).astype(int).T
    step = (1 / MIN_DEPTH - 1 / MAX_DEPTH) / (PLANES - 1) / CAMERA_DISTANCE
    exact = depths["2"][row, column]
    assert np.median(np.abs(1 / place[:, 2] - 1 / exact)) < step / 2


@pytest.fixture(scope="module")
def all_points(table):
    """Points on all pixels."""
    return swept(table, lambda view: None)


def test_transparent_pixels_give_no_points(table, all_points):
    shown = {view.name: opaque_pixels(view) for view in table[0]}
    assert not any((shown[name] & np.isinf(depth)).any() for name, depth in table[1].items())
    assert 500 < len(swept(table, opaque_pixels)) < len(all_points)


def test_masked_pixels_give_no_points(table, tmp_path):
    left = np.zeros((SIDE, SIDE, 4), np.uint8)
    left[:, : SIDE // 2] = 255
    write_image(tmp_path / "mask.png", left)
    view = table[0][0]
    np.testing.assert_array_equal(
        opaque_pixels(replace(view, mask_path=tmp_path / "mask.png")), opaque_pixels(view) & (left[:, :, 0] > 0)
    )


def test_points_near_existing_ones_are_not_new():
    """Of four pixels at depth 2: a point in it, one behind it, one before it, none; a plane is 0.1 of inverse depth."""
    view = View("a", Camera(4, 1, 1, 1, 2, 0.5), np.eye(4)[:3])
    surface = Surface(view, np.zeros((1, 4, 3)), np.full((1, 4), 0.5), 0.1)
    depths, columns = np.array([2.3, 3.0, 1.0]), np.array([0, 1, 2])
    points = np.stack([(columns - 1.5) * depths, 0 * depths, depths], axis=1)
    behind = np.array([[0, 0, -1.0]])
    for order in (points, points[::-1], np.concatenate([points, behind, [[1.5 * 9, 0, 9], [-0.5 * 9, 0, 9]]])):
        assert surface.is_new(order).tolist() == [[False, True, False, True]]


def test_missing_surfaces_are_added(rng):
    views, photographs = wall_views(rng, 4)
    center, load = np.array([0, 0, DEPTH]), lambda view: photographs[view.name]
    alone = sweep_points(views, center, load, 10**6, 0).positions
    left = alone[alone[:, 0] < 0].astype(np.float64)
    new = sweep_points(views, center, load, 10**6, 0, points=left).positions
    assert len(new) < 0.6 * len(alone)
    assert np.mean(new[:, 0] > -0.1) > 0.95


def test_added_points_are_reproducible(table, all_points):
    first, second = all_points, swept(table, lambda view: None)
    for name in ("positions", "colors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert len(sweep_points(table[0], LOOK_AT, before_a_sky, 700, 0)) == 700 < len(first)


@pytest.mark.large
def test_real_surfaces_are_covered():
    """Nine tenths of what structure from motion found has a swept point within three hundredths of its distance."""
    scene = read_scene(data_set("fox"))
    views = scene.split("train")
    center = scene_center(views)
    points = sweep_points(views, center, load_image, 100_000, 0)
    distance = np.median([np.linalg.norm(view.position - center) for view in views])
    gaps, _ = cKDTree(points.positions).query(scene.points.positions)
    assert np.quantile(gaps, 0.9) < 0.03 * distance


@pytest.mark.parametrize(
    ("more", "found", "alpha", "joined"), [(1, 70, False, 70), (1, 0, False, 0), (0, 70, False, 0), (1, 70, True, 0)]
)
def test_scene_with_few_points_is_swept(tiny_scene, tmp_path, monkeypatch, caplog, more, found, alpha, joined):
    """more: than the scene's points are enough."""
    own, file = len(read_scene(tiny_scene).points), tmp_path / "start.yaml"
    cloud = PointCloud(np.random.default_rng(0).random((found, 3), np.float32), np.zeros((found, 3), np.float32))
    monkeypatch.setattr("clsplat.stages.init.sweep_points", lambda *arguments: cloud)
    monkeypatch.setattr("clsplat.stages.init.is_transparent", lambda scene: alpha)
    stages = f"[{{init: {{min_points: {own + more}}}}}, {{optimize: {{steps: 1, losses: [l1]}}}}, export]"
    file.write_text(f"name: start\nstages: {stages}\n")
    caplog.set_level("INFO", "clsplat")
    run = train(tiny_scene, tmp_path / "run", pipeline=str(file))
    log = caplog.text
    swept = bool(more) and not alpha
    assert f"{own + joined:,} Gaussians from the scene's points{' and a plane sweep' if swept else ''}" in log
    assert run.model.gaussians.count == own + joined


def test_points_and_sweep_are_combined(tiny_scene, tmp_path, caplog):
    scene = read_scene(tiny_scene)
    caplog.set_level("INFO", "clsplat")
    sets = ("init.source=points+sweep", "init.sweep_points=60", "optimize.steps=1")
    train(tiny_scene, tmp_path / "run", *sets)
    match = re.search(r"([\d,]+) Gaussians from the scene's points and a plane sweep", caplog.text)
    assert match
    expected = Init(source="points+sweep", sweep_points=60).expected_count(scene)
    assert len(scene.points) < int(match[1].replace(",", "")) <= expected == len(scene.points) + 60


def test_empty_sweep_is_reported(tiny_scene, tmp_path, monkeypatch, caplog):
    nothing = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    monkeypatch.setattr("clsplat.stages.init.sweep_points", lambda *arguments: nothing)
    run = train(tiny_scene, tmp_path / "run", "init.source=points+sweep", "optimize.steps=1")
    assert "found no additional points" in caplog.text
    assert run.model.gaussians.count == len(read_scene(tiny_scene).points)


def test_points_and_sweep_need_points(tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "bare", ignore=shutil.ignore_patterns("points3d.ply"))
    with pytest.raises(DataError, match=r"no points; use `init: \{source: sweep\}`"):
        train(tmp_path / "bare", tmp_path / "run", "init.source=points+sweep")
