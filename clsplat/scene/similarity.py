"""Fit similarity transforms to corresponding points, ignore outliers, and apply the transforms to scenes."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import comb
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, pluralize
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.viewpoint import perpendicular

Floats = NDArray[np.float64]
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Similarity:
    """The transform x -> scale · rotation x + translation, in float64."""

    scale: float = 1.0
    rotation: Floats = field(default_factory=lambda: np.eye(3))  # [3, 3]
    translation: Floats = field(default_factory=lambda: np.zeros(3))  # [3]

    @property
    def matrix(self) -> Floats:
        """The transform as a matrix, [4, 4]."""
        return np.vstack([np.column_stack([self.scale * self.rotation, self.translation]), [0, 0, 0, 1]])

    def apply(self, points: NDArray[np.floating]) -> Floats:
        """Return transformed points, [N, 3]."""
        return np.asarray(self.scale * points.astype(np.float64) @ self.rotation.T + self.translation)

    def transform_view(self, view: View) -> View:
        """Return a view that shows the transformed scene as `view` shows the original one."""
        rotation = view.world_to_camera[:, :3] @ self.rotation.T
        translation = self.scale * view.world_to_camera[:, 3] - rotation @ self.translation
        return replace(view, world_to_camera=np.column_stack([rotation, translation]), camera_to_world=None)

    def transform_scene(self, scene: Scene) -> Scene:
        """Return a scene in transformed world coordinates, with origin 0 and float64 points, for camera files."""
        scene = scene.in_world()
        points, tracks = scene.points, scene.tracks
        return replace(
            scene,
            views=tuple(map(self.transform_view, scene.views)),
            points=points and replace(points, positions=self.apply(points.positions)),
            tracks=tracks and replace(tracks, positions=self.apply(tracks.positions)),
            extent=self.scale * scene.extent,
        )


def rotation_between(start: Floats, end: Floats) -> Floats:
    """Return the smallest rotation, [3, 3], that maps the unit vector `start` to the unit vector `end`."""
    cosine = float(start @ end)
    if cosine < -1 + 1e-12:
        axis = perpendicular(start)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    x, y, z = np.cross(start, end)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


# Least squares (Umeyama 1991), and outliers.

MIN_SPREAD = 1e-3  # smallest spread of points across their main direction, relative to the spread along it


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points, and the positions to which a similarity transform should map them."""

    source: Floats  # [N, 3]
    target: Floats  # [N, 3]
    scale: float | None = None  # the scale, if it is known
    up: Floats | None = None  # [3], unit: the direction in source coordinates that becomes +z, if it is known

    @property
    def minimum(self) -> int:
        """The number of points that determine the transform."""
        return 3 if self.up is None else 2

    def fit(self, rows: NDArray[np.intp] | None = None) -> Similarity:
        """Return the transform with the smallest sum of squared distances, of all points or of some rows."""
        source, target = (self.source, self.target) if rows is None else (self.source[rows], self.target[rows])
        source_center, target_center = source.mean(axis=0), target.mean(axis=0)
        a, b = source - source_center, target - target_center
        if self.up is None:
            u, _, v = np.linalg.svd(b.T @ a)
            rotation = u @ np.diag([1, 1, np.linalg.det(u) * np.linalg.det(v)]) @ v
        else:
            upright = rotation_between(self.up, Z)
            x, y, _ = (a @ upright.T).T
            angle = np.arctan2((x * b[:, 1] - y * b[:, 0]).sum(), (x * b[:, 0] + y * b[:, 1]).sum())
            cosine, sine = np.cos(angle), np.sin(angle)
            rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ upright
        scale = self.scale or float((b * (a @ rotation.T)).sum() / max((a**2).sum(), 1e-300))
        return Similarity(scale, rotation, target_center - scale * rotation @ source_center)

    def distances(self, transform: Similarity) -> Floats:
        """Return the distance of each transformed point from its target, [N]."""
        return np.asarray(np.linalg.norm(transform.apply(self.source) - self.target, axis=1))

    def fit_inliers(self) -> tuple[Similarity, NDArray[np.bool_]]:
        """Return the least-squares transform of the points without outliers, and a mask of the outliers, [N].

        Raises DataError if the points do not determine the transform.
        """
        count = len(self.source)
        if count < self.minimum:
            remedy = "3 points, or 2 with --level" if self.up is None else "2 points"
            raise DataError(f"{pluralize(count, 'point')} with known coordinates; expected at least {remedy}")
        floor = ROUNDING * float(np.linalg.norm(self.target - np.median(self.target, axis=0), axis=1).max())
        transform, is_outlier = fit_without_outliers(self.fit, self.distances, count, self.minimum, floor)
        self._require_determined(transform, ~is_outlier)
        return transform, is_outlier

    def _require_determined(self, transform: Similarity, is_inlier: NDArray[np.bool_]) -> None:
        """Raise DataError if the points contradict each other, or are nearly on a line compared with their errors."""
        points = transform.scale * (self.source[is_inlier] - self.source[is_inlier].mean(axis=0))
        error = float(np.sqrt((self.distances(transform)[is_inlier] ** 2).mean()))
        size = float(np.linalg.norm(points) / np.sqrt(len(points)))
        if self.up is not None:
            points = points - np.outer(points @ self.up, self.up)
        spreads = np.linalg.svd(points, compute_uv=False) / np.sqrt(len(points))
        if spreads[1 if self.up is None else 0] > max(error, MIN_SPREAD * spreads[0]) and transform.scale > 0:
            return
        if error > size / 2:
            values = "coordinates" if self.scale is None else "coordinates and --distance"
            raise DataError(
                f"the points do not fit their known coordinates: the RMS error after alignment is {error:.3g}, and the "
                f"points spread over only {size:.3g}; check the {values}"
            )
        shape = "nearly on a line" if self.up is None else "above each other"
        remedy = "add --level, or add points away from that line" if self.up is None else "add points at other places"
        raise DataError(
            f"the points are {shape}, up to their errors of {error:.3g}, so they do not determine the rotation; "
            f"{remedy}"
        )


ROUNDING = 1e-6  # relative to the spread of the targets; smaller distances are rounding errors
OUTLIER_DISTANCE = 3.0  # times the median distance; for normal errors, 4.6 standard deviations of a coordinate
MAX_SAMPLES = 1000
MAX_ROUNDS = 20
Fit = TypeVar("Fit")


def fit_without_outliers(
    fit: Callable[[NDArray[np.intp]], Fit],
    distances: Callable[[Fit], Floats],
    count: int,
    minimum: int,
    floor: float,
) -> tuple[Fit, NDArray[np.bool_]]:
    """Return a fit to the inliers among `count` observations, and a mask of the outliers, [count].

    The iteration starts at the fit to `minimum` observations with the least median of squares (Rousseeuw 1984).
    With fewer than minimum + 2 observations, all are inliers, because an outlier cannot be identified.  floor: the
    distance below which no observation is an outlier.
    """
    all_rows = np.arange(count)
    if count < minimum + 2:
        return fit(all_rows), np.zeros(count, bool)
    middle = (count + minimum + 1) // 2 - 1  # highest breakdown point
    best = min(map(fit, _samples(count, minimum)), key=lambda model: np.partition(distances(model), middle)[middle])
    scale = OUTLIER_DISTANCE * (1 + 5 / (count - minimum))  # small samples underestimate the median
    errors, is_inlier = distances(best), np.zeros(count, bool)
    limit = max(floor, scale * float(np.partition(errors, middle)[middle]))
    for _ in range(MAX_ROUNDS):
        was_inlier, is_inlier = is_inlier, errors <= limit
        if (is_inlier == was_inlier).all():
            break
        best = fit(np.flatnonzero(is_inlier))
        errors = distances(best)
        limit = max(floor, scale * float(np.median(errors)))
    return best, ~is_inlier


def _samples(count: int, size: int) -> Iterable[NDArray[np.intp]]:
    """Return all subsets of `size` numbers below `count`, or MAX_SAMPLES random subsets, the same in each call."""
    if comb(count, size) <= MAX_SAMPLES:
        return map(np.array, combinations(range(count), size))
    rng = np.random.default_rng(0)
    return (rng.choice(count, size, replace=False) for _ in range(MAX_SAMPLES))


# Level scenes.

UP = np.array([0.0, -1.0, 0.0])  # as in an OpenCV camera; the viewer and other programs assume it for PLY files


def level(
    up: NDArray[np.floating], anchor: NDArray[np.floating], height: float | None = None, scale: float = 1.0
) -> Similarity:
    """Return the transform that rotates the unit vector `up`, [3], to -y, and scales around the point `anchor`, [3].

    height: the height of the ground along `up`; the transform moves the ground to y = 0.
    """
    rotation, target = rotation_between(np.asarray(up, np.float64), UP), np.array(anchor, np.float64)
    if height is not None:
        anchor, target[1] = anchor + (height - up @ anchor) * up, 0.0
    return Similarity(scale, rotation, target - scale * rotation @ anchor)
