"""What a camera path is made from: where the photographs were taken, what they look at, and which way is up."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.scene.camera import Camera
from clsplat.scene.scene import strayed
from clsplat.scene.stand import closest_point, upward
from clsplat.scene.view import View

Floats = NDArray[np.floating]
MOST_POINTS = 20_000  # that are looked at for near and far
SHARES = 0.05, 0.95  # of what a camera sees lies before near, and before far
PARALLEL = 0.9  # length of the mean direction of view, from which on the axes hardly say where they meet
BEYOND = 1.5  # times near and far: farther from what is seen they do not meet
TOWARDS = 0.5  # share of the cameras that must have the focus before them


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene without those that strayed, and points of what they look at."""

    views: Sequence[View]
    points: Floats  # [M, 3], the means of a model or the points of a scene

    @classmethod
    def of(cls, views: Sequence[View], points: Floats) -> "Rig":
        """Leave out cameras far away from all others, and points that are not finite.

        Raises DataError without a view.
        """
        if not views:
            raise DataError("a camera path needs the cameras of a scene; there is none")
        stray = strayed(views)
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        step = -(-len(finite) // MOST_POINTS) or 1
        return cls([view for view, far in zip(views, stray, strict=True) if not far], finite[::step])

    @cached_property
    def positions(self) -> Floats:
        """Camera centres, [V, 3]."""
        return np.stack([view.position for view in self.views])

    @cached_property
    def forwards(self) -> Floats:
        """Directions of view, [V, 3]."""
        return np.stack([view.world_to_camera[2, :3] for view in self.views])

    @cached_property
    def ups(self) -> Floats:
        """Upward axes of the images, [V, 3]."""
        return np.stack([-view.world_to_camera[1, :3] for view in self.views])

    @cached_property
    def up(self) -> Floats:
        """What is up, [3], unit."""
        return upward(self.views)

    @cached_property
    def focus(self) -> Floats:
        """The point nearest to the optical axes, [3]; of axes that are almost parallel, one amid what they show.

        Raises DataError where most cameras look away from it.
        """
        middle = np.median(self.points, axis=0) if len(self.points) else self.positions.mean(axis=0)
        focus = closest_point(self.positions, self.forwards, middle)
        forward, (near, far) = self.forwards.mean(axis=0), self.depths
        ahead = float(np.median(self._before(focus)))
        if np.linalg.norm(forward) > PARALLEL and not near / BEYOND < ahead < far * BEYOND:
            focus = self.positions.mean(axis=0) + unit(forward) * (near + far) / 2
        if (self._before(focus) > 0).mean() < TOWARDS:
            raise DataError(
                "the cameras look away from each other, so that there is nothing to turn about; use the path through"
            )
        return focus

    def _before(self, point: Floats) -> Floats:
        """The depth of a point in each view, [V]."""
        return np.asarray(((point - self.positions) * self.forwards).sum(axis=1))

    @cached_property
    def depths(self) -> tuple[float, float]:
        """Near and far: between them lies most of what the cameras see, scene units."""
        found = [self._seen(view) for view in self.views[:: -(-len(self.views) // 64)]]
        depths = np.concatenate(found)
        if not len(depths):
            return 1.0, 10.0
        near, far = np.quantile(depths, SHARES)
        return float(near), float(far)

    def _seen(self, view: View) -> Floats:
        """Depths of the points in a view's image."""
        x, y, z = view.world_to_camera[:, :3] @ self.points.T + view.world_to_camera[:, 3:]
        c = view.camera
        with np.errstate(all="ignore"):
            u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < c.width) & (v < c.height)
        return np.asarray(z[inside])

    @cached_property
    def camera(self) -> Camera:
        """The camera whose field of view is the middle one."""
        cameras = sorted((view.camera for view in self.views), key=lambda c: c.width * c.height / (c.fx * c.fy))
        return cameras[len(cameras) // 2]


def unit(vectors: Floats) -> Floats:
    """Return vectors, [..., 3], with length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
