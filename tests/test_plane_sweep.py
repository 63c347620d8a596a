"""The plane sweep finds surfaces: a textured wall at a known place, and those that structure from motion found."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.scene.detect import read_scene
from clsplat.scene.middle import centre_of
from clsplat.scene.plane_sweep import swept_points
from clsplat.scene.scene import Camera, PointCloud, View
from clsplat.scene.view import load_image
from tests.data_sets import data_set
from tests.test_training import train

DEPTH = 4.0


def wall_views(rng, count=6):
    """Views of a wall z = 4 with smooth noise on it, and their photographs by name."""
    texture = cv2.GaussianBlur(rng.random((400, 400, 3)).astype(np.float32), (0, 0), 3)
    texture = (texture - texture.min()) / np.ptp(texture) * 255
    camera = Camera(120, 90, 100, 100, 60, 45)
    views, photographs = [], {}
    for i in range(count):
        centre = np.array([0.25 * i - 0.6, 0.1 * (i % 2), 0])
        views.append(View(str(i), camera, np.column_stack([np.eye(3), -centre]), Path("none")))
        columns, rows = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
        x, y = (columns - 60) / 100 * DEPTH + centre[0], (rows - 45) / 100 * DEPTH + centre[1]
        maps = (200 + 50 * x).astype(np.float32), (200 + 50 * y).astype(np.float32)
        photographs[str(i)] = cv2.remap(texture, *maps, cv2.INTER_LINEAR).astype(np.uint8)
    return views, photographs


def test_a_wall_is_found_where_it_is(rng):
    views, photographs = wall_views(rng)
    points = swept_points(views, np.array([0, 0, DEPTH]), lambda view: photographs[view.name], 5000, 0)
    assert len(points) == 5000
    depth = points.positions[:, 2]
    assert np.mean(np.abs(depth - DEPTH) < 0.05 * DEPTH) > 0.95
    row = (45 + 100 * (points.positions[:, 1] - 0) / depth).astype(int)  # seen by the view at (-0.1, 0, 0)
    column = (60 + 100 * (points.positions[:, 0] + 0.1) / depth).astype(int)
    seen = (row >= 0) & (row < 90) & (column >= 0) & (column < 120)
    difference = np.abs(points.colours[seen] * 255 - photographs["2"][row[seen], column[seen]])
    assert np.median(difference) < 12


def test_the_same_points_every_time(rng):
    views, photographs = wall_views(rng)
    first, second = (swept_points(views, np.array([0, 0, 4.0]), lambda v: photographs[v.name], 700, 3) for _ in "ab")
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.colours, second.colours)


def test_photographs_that_have_nothing_in_common(rng):
    views, photographs = wall_views(rng)
    noise = {name: rng.integers(0, 256, image.shape).astype(np.uint8) for name, image in photographs.items()}
    assert len(swept_points(views, np.array([0, 0, 4.0]), lambda view: noise[view.name], 5000, 0)) < 2500
    assert len(swept_points(views[:1], np.array([0, 0, 4.0]), lambda view: noise[view.name], 5000, 0)) == 0


@pytest.mark.large
def test_real_surfaces():
    """Nine tenths of what structure from motion found has a swept point within three hundredths of its distance."""
    scene = read_scene(data_set("fox"))
    views = scene.split("train")
    centre = centre_of(views)
    points = swept_points(views, centre, load_image, 100_000, 0)
    distance = np.median([np.linalg.norm(view.position - centre) for view in views])
    gaps, _ = cKDTree(points.positions).query(scene.points.positions)
    assert np.quantile(gaps, 0.9) < 0.03 * distance


@pytest.mark.parametrize(
    ("more", "found", "alpha", "joined"), [(1, 70, False, 70), (1, 0, False, 0), (0, 70, False, 0), (1, 70, True, 0)]
)
def test_a_scene_with_few_points_is_swept(tiny_scene, tmp_path, monkeypatch, caplog, more, found, alpha, joined):
    """more: than the scene's points are enough."""
    own, file = len(read_scene(tiny_scene).points), tmp_path / "start.yaml"
    cloud = PointCloud(np.random.default_rng(0).random((found, 3), np.float32), np.zeros((found, 3), np.float32))
    monkeypatch.setattr("clsplat.stages.init.swept_points", lambda *arguments: cloud)
    monkeypatch.setattr("clsplat.stages.init.is_transparent", lambda scene: alpha)
    stages = f"[{{init: {{fewest: {own + more}}}}}, {{optimize: {{steps: 1, losses: [l1]}}}}, export]"
    file.write_text(f"name: start\nstages: {stages}\n")
    caplog.set_level("INFO", "clsplat")
    run = train(tiny_scene, tmp_path / "run", pipeline=str(file))
    log = caplog.text
    swept = bool(more) and not alpha
    assert f"{own + joined:,} Gaussians from the scene's points{' and a sweep' if swept else ''}" in log
    assert run.model.gaussians.count == own + joined
