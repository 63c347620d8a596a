"""The extent of a scene, and outlier cameras that must not affect it."""

import numpy as np
import pytest

from clsplat.scene.camera import Camera
from clsplat.scene.scene import camera_extent, outlier_cameras
from clsplat.scene.view import View


def views_at(centers):
    poses = [np.column_stack([np.eye(3), -np.asarray(center, float)]) for center in centers]
    return [View(f"{i}.png", Camera(4, 4, 4, 4, 2, 2), pose, f"{i}.png") for i, pose in enumerate(poses)]


def orbit(count=24, radius=3.0):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, 1.0)], axis=1)


@pytest.mark.parametrize("distance", [1e2, 1e5, 1e9])
def test_far_camera_does_not_change_the_extent(distance):
    """Learning rates and thresholds follow the extent."""
    healthy = orbit()
    assert camera_extent(views_at([*healthy, (distance, 0, 0)])) == camera_extent(views_at(healthy))
    assert outlier_cameras(views_at([*healthy, (distance, 0, 0)])).tolist() == [False] * 24 + [True]


@pytest.mark.parametrize(
    "centers",
    [
        orbit(),
        [(x, 0, 0) for x in range(100)],
        [(0, 0, 0)] * 5,
        [(0, 0, 0)] * 5 + [(1, 0, 0)],
        [*orbit(40, 1.0), *orbit(20, 30.0)],
        [(0, 0, 0), (1, 0, 0)],
        [(0, 0, 0)],
    ],
    ids=["orbit", "walk", "one place", "one step", "close-ups and overviews", "two", "one"],
)
def test_all_valid_cameras_count(centers):
    views = views_at(centers)
    assert not outlier_cameras(views).any()
    points = np.asarray(centers, float)
    radius = 1.1 * np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    assert camera_extent(views) == pytest.approx(radius or 1.0)
