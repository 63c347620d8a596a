"""Where a scene is looked at: which way is up, what the cameras look at, and where one who looks begins."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.camera import Camera
from clsplat.scene.view import View

MIN_UP = 0.1  # length of the mean of the upward axes: below it the cameras do not agree
LEVEL = 0.02  # weight of that mean beside the rightward axes, squared: cameras are held level to about 4 degrees
MAX_PITCH = 60.0  # degrees between that mean and what is up; further apart, cameras lie on their sides
PRIOR = 1e-3  # weight of the splats' middle, beside the axes: where all are parallel, nothing else says how far
START = Camera(1200, 900, 1100.0, 1100.0, 600.0, 450.0)  # where there is no view
SHARES = 0.05, 0.95  # of the splats, along each axis, are before and behind the sides of the box that is looked at
DISTANCE = 2.2  # of that start from its middle, in halves of its diagonal


@dataclass(frozen=True)
class Stand:
    """The frame of all motion of one who looks, in scene units."""

    pivot: NDArray[np.floating]  # [3]
    up: NDArray[np.floating]  # [3], unit
    radius: float
    focal: float  # px, the median of the views: what a screen filter without compensation belongs to
    start: View

    @classmethod
    def of(cls, points: NDArray[np.floating], views: Sequence[View], first: View | None) -> "Stand":
        """Look from `first`, else at most of the points from outside.  points: [N, 3], what is to be seen."""
        means = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        low, high = np.quantile(means, SHARES, axis=0) if len(means) else np.zeros((2, 3))
        middle, spread = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        if first is None or not views:
            up = np.array([0.0, -1.0, 0.0])  # as cameras of COLMAP stand
            radius = spread or 1.0
            eye = middle + DISTANCE * radius * np.array([0.35, -0.25, -0.9])
            return cls(middle, up, radius, START.fx, View.looking_at(eye, middle, up, START, "start"))
        poses = np.stack([view.world_to_camera for view in views])
        centres = np.stack([view.position for view in views])
        pivot = closest_point(centres, poses[:, 2, :3], middle)
        radius = float(np.median(np.linalg.norm(centres - pivot, axis=1))) or spread or 1.0
        return cls(pivot, upward(views), radius, float(np.median([view.camera.fx for view in views])), first)


def upward(views: Sequence[View]) -> NDArray[np.float64]:
    """Return what is up, unit, [3]: what most rightward axes of views are across, as cameras are held level.

    Where all look the same way, that is undecided, and the mean of their upward axes, in which cameras that look down
    lean, decides; so it does where most lie on their sides.  Where it cancels out, cameras look down more than up.
    """
    poses = np.stack([view.world_to_camera for view in views]).astype(np.float64)
    right, mean, ahead = poses[:, 0, :3], -poses[:, 1, :3].mean(axis=0), poses[:, 2, :3].mean(axis=0)
    level = right.T @ right / len(right) - LEVEL * np.outer(mean, mean)
    axis = np.linalg.eigh(level).eigenvectors[:, 0]
    length = float(np.linalg.norm(mean))
    if length <= MIN_UP:
        return np.asarray(-axis if axis @ ahead > 0 else axis, np.float64)
    leans = abs(axis @ mean) < np.cos(np.radians(MAX_PITCH)) * length
    return np.asarray(mean / length if leans else axis * np.sign(axis @ mean), np.float64)


def across(up: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return a unit direction across a unit one, both [3]."""
    found = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return np.asarray(found / np.linalg.norm(found), np.float64)


def closest_point(
    centres: NDArray[np.floating], axes: NDArray[np.floating], prior: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the point, [3], with the least squared distances to lines; weakly drawn to `prior`.

    centres, axes: [V, 3], a point of each line and its unit direction.
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weight = PRIOR * len(centres)
    matrix = across.sum(axis=0) + weight * np.eye(3)
    return np.asarray(np.linalg.solve(matrix, np.einsum("vij,vj->i", across, centres) + weight * prior))
