"""Which way is up in a scene, and what its cameras look at."""

import numpy as np
import pytest

from clsplat.inspect import space
from clsplat.report import cameras
from clsplat.scene.camera import Camera
from clsplat.scene.stand import Stand, closest_point, upward
from clsplat.scene.view import View
from clsplat.video.rig import Rig

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
UPS = {  # upward axes of views, and what they agree on
    "alike": ([[0, -1, 0], [0.6, -0.8, 0]], [0.6, -1.8, 0]),
    "most alike": ([[0, 0, 1], [0, 0, -1], [0, 1, 0]], [0, 1, 0]),
    "opposite": ([[1, 0, 0], [-1, 0, 0]], [1, 0, 0]),
}


@pytest.mark.parametrize("case", UPS)
def test_all_take_the_same_way_for_up(case):
    ups, expected = UPS[case]
    views = [
        View.looking_at((i, 5, i), np.add((i, 5, i), np.cross(up, (1, 2, 3))), up, CAMERA) for i, up in enumerate(ups)
    ]
    up, points = np.array(expected) / np.linalg.norm(expected), np.zeros((9, 3), np.float32)
    np.testing.assert_allclose(upward(views), up, atol=1e-12)
    np.testing.assert_allclose(Rig.of(views, points).up, up, atol=1e-12)
    np.testing.assert_allclose(Stand.of(points, views, views[0]).up, up, atol=1e-12)
    np.testing.assert_allclose(space._axes(views)[2], up, atol=1e-12)
    np.testing.assert_allclose(np.cross(*cameras._axes(views)), -up, atol=1e-12)


def test_the_pivot_is_where_the_axes_meet():
    centre = np.array([1.0, -2.0, 3.0])
    places = np.random.default_rng(0).normal(0, 4, (12, 3))
    axes = (centre - places) / np.linalg.norm(centre - places, axis=1, keepdims=True)
    np.testing.assert_allclose(closest_point(places, axes, centre + 5), centre, atol=0.02)


def test_parallel_axes_meet_at_the_depth_of_the_splats():
    places = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]])
    found = closest_point(places, np.tile([0.0, 0, 1], (4, 1)), np.array([9.0, 9, 7]))
    np.testing.assert_allclose(found, [1, 1, 7], atol=0.02)
