"""The up direction of a scene, and the point that its cameras look at."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint, nearest_to_axes, perpendicular, up_direction
from clsplat.viewer.video.paths import Rig

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
UP = np.array([0.0, -0.8, 0.6])


def orbit(pitch, angles, up=UP):
    """Views to the sides, by angles in degrees around an axis, that look down by a pitch."""
    side = perpendicular(up)
    around = [np.cos(a) * side + np.sin(a) * np.cross(up, side) for a in np.radians(angles)]
    aheads = [np.cos(np.radians(pitch)) * one - np.sin(np.radians(pitch)) * up for one in around]
    return [
        looking(3 * i * side, ahead, one if pitch == 90 else up)
        for i, (ahead, one) in enumerate(zip(aheads, around, strict=True))
    ]


def looking(eye, ahead, up):
    return View.looking_at(eye, eye + ahead, up, CAMERA)


def rolled(view, degrees):
    """The same view with the camera turned about its axis."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return replace(view, world_to_camera=(turn @ view.world_to_camera).astype(view.world_to_camera.dtype))


def tilted(views, degrees):
    """The same views, each rolled by so many degrees."""
    return [rolled(view, angle) for view, angle in zip(views, degrees, strict=True)]


CASES = {  # views, and what is up within so many degrees
    "all round": (orbit(0, range(0, 360, 40)), UP, 0.1),
    "a third of the way round, from above": (orbit(50, range(0, 130, 10)), UP, 0.1),
    "the same, steeper": (orbit(70, range(0, 130, 10)), UP, 0.1),
    "looking up, all round": (orbit(-70, range(0, 320, 40)), UP, 0.1),
    "straight down, to all sides": (orbit(90, range(0, 320, 40)), UP, 0.1),
    "straight down, there and back": (orbit(90, [0] * 11 + [180] * 9), UP, 0.1),
    "one way": (orbit(20, [0, 0, 0]), UP, 20.1),
    "turned little, and rolled along": (tilted(orbit(0, range(-12, 13, 2)), np.linspace(-9, 9, 13)), UP, 4),
    "turned little, and rolled much": (tilted(orbit(0, [-8, -4, 0, 4, 8]), [20, -25, 0, 25, -20]), UP, 4),
    "some on their side": ([*orbit(10, range(0, 300, 40)), *tilted(orbit(10, [300, 340]), [90, 90])], UP, 25),
    "one": (orbit(0, [70]), UP, 0.1),
    "two that look at each other": (orbit(0, [0, 180]), UP, 0.1),
}


@pytest.mark.parametrize("case", CASES)
def test_up_direction_is_shared_by_its_users(case):
    views, expected, degrees = CASES[case]
    up, points = up_direction(views), np.zeros((9, 3), np.float32)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert np.degrees(np.arccos(min(1, up @ expected))) < degrees
    np.testing.assert_allclose(Rig.from_views(views, points).up, up, atol=1e-12)
    np.testing.assert_allclose(Viewpoint.from_points(points, views, views[0]).up, up, atol=1e-12)


def test_sideways_views_use_the_mean_upward_axis():
    views = [rolled(view, 90) for view in orbit(0, range(0, 100, 10))]
    mean = np.mean([-view.world_to_camera[1, :3] for view in views], axis=0)
    np.testing.assert_allclose(up_direction(views), mean / np.linalg.norm(mean), atol=1e-6)


def test_pivot_is_where_view_axes_meet():
    center = np.array([1.0, -2.0, 3.0])
    places = np.random.default_rng(0).normal(0, 4, (12, 3))
    axes = (center - places) / np.linalg.norm(center - places, axis=1, keepdims=True)
    np.testing.assert_allclose(nearest_to_axes(places, axes, center + 5), center, atol=0.02)


def test_parallel_axes_meet_at_the_depth_of_the_splats():
    places = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]])
    result = nearest_to_axes(places, np.tile([0.0, 0, 1], (4, 1)), np.array([9.0, 9, 7]))
    np.testing.assert_allclose(result, [1, 1, 7], atol=0.02)
