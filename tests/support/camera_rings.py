"""Cameras on a ring, and lenses that distort."""

import numpy as np

from clsplat.scene.camera import Camera, Lens
from clsplat.scene.view import View
from clsplat.viewer.video.paths import Rig

STRONG = Lens(200, 150, "OPENCV", (160.0, 165.0, 97.0, 80.0, -0.25, 0.06, 0.002, -0.001))


FISHEYE = Lens(200, 150, "OPENCV_FISHEYE", (90.0, 91.0, 101.0, 74.0, 0.02, -0.01, 0.003, 0.0))


CAMERA = Camera(200, 150, 180.0, 180.0, 101.0, 74.0)


SIZE = 64, 48


UP = np.array([0.0, 0.0, 1.0])


def ring(angles, radius=3.0, height=1.0, target=(0.0, 0.0, 0.0)):
    """Views on a ring about the z axis."""
    places = [(radius * np.cos(a), radius * np.sin(a), height) for a in angles]
    return [View.looking_at(p, target, UP, CAMERA, f"{i:03d}") for i, p in enumerate(places)]


def rig_of(views, rng=None):
    points = np.zeros((1, 3)) if rng is None else rng.normal(size=(500, 3)) * 0.3
    return Rig.from_views(views, points)
