"""Find the up direction of a scene, the point that its cameras look at, and the start view of the viewer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.formats.splats import typical_size
from clsplat.scene.camera import Camera
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import View

MIN_TURN = 0.1  # smallest second eigenvalue of the right axes of cameras that turn enough: 18 degrees
MAX_ROLL = 0.15  # largest ratio of the smallest to the second eigenvalue for level cameras
MIN_UP = 0.2  # smallest component of the mean up axis that determines the sign of the up direction
MIN_AGREEMENT, MAX_TILT = 0.5, 75.0  # a mean up axis longer than MIN_AGREEMENT is at most MAX_TILT degrees off
PRIOR = 1e-3  # weight of the center of the splats, which determines the distance if all axes are parallel
START_CAMERA = Camera(1200, 900, 1100.0, 1100.0, 600.0, 450.0)  # camera of a scene without views
QUANTILES = 0.05, 0.95  # quantiles of the splats along each axis: the faces of the box to look at
DISTANCE = 2.2  # from the start view to the center of the box, divided by half the diagonal of the box
TOWARD_START = np.array([0.35, -0.25, -0.9])  # direction from the center to the start view
NO_GROUND = "omit --level, or use `clsplat align SCENE OUT --level cameras`"
VISIBLE_FRACTION, MARGIN = 0.999, 1.05  # fraction of the splats in the start view, and a factor for space around them
MAX_ZOOM_OUT = 2.0  # times the usual distance; splats that need more have a background, which may be outside the image


@dataclass(frozen=True)
class Viewpoint:
    """The initial view of the viewer, with the pivot and up vector of its motion.

    Lengths are in scene units, except `focal`.
    """

    pivot: NDArray[np.floating]  # [3]
    up: NDArray[np.floating]  # [3], unit
    radius: float
    focal: float  # px, the median of the views, for screen filters without compensation
    start: View

    @classmethod
    def from_points(cls, points: NDArray[np.floating], views: Sequence[View], first: View | None) -> "Viewpoint":
        """Return a viewpoint that starts at the view `first`.

        If `first` is None or there are no views, it starts at a distance from which most points are visible.

        points: the centers of the splats, [N, 3].
        """
        means = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        low, high = np.quantile(means, QUANTILES, axis=0) if len(means) else np.zeros((2, 3))
        center, spread = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        if first is None or not views:
            up = np.array([0.0, -1.0, 0.0])  # up in an OpenCV camera
            radius = spread or 1.0
            start = View.looking_at(center + DISTANCE * radius * TOWARD_START, center, up, START_CAMERA, "start")
            distance = _distance_to_show_all(start, means - center) if len(means) else 0.0
            if DISTANCE * radius < distance <= MAX_ZOOM_OUT * DISTANCE * radius:
                start = View.looking_at(center + distance * TOWARD_START, center, up, START_CAMERA, "start")
            return cls(center, up, radius, START_CAMERA.fx, start)
        poses = np.stack([view.world_to_camera for view in views])
        centers = np.stack([view.position for view in views])
        pivot = nearest_to_axes(centers, poses[:, 2, :3], center)
        radius = float(np.median(np.linalg.norm(centers - pivot, axis=1))) or spread or 1.0
        return cls(pivot, up_direction(views), radius, float(np.median([view.camera.fx for view in views])), first)


def _distance_to_show_all(start: View, offsets: NDArray[np.floating]) -> float:
    """Return the distance from the center at which `start` shows nearly all points, in multiples of TOWARD_START.

    offsets: the points minus the center, [N, 3].
    """
    right, down, forward = start.world_to_camera[:, :3] @ offsets.T
    camera = start.camera
    sides = np.maximum(np.abs(right) * camera.fx / camera.cx, np.abs(down) * camera.fy / camera.cy)
    return MARGIN * float(np.quantile(sides - forward, VISIBLE_FRACTION)) / float(np.linalg.norm(TOWARD_START))


def circle_views(points: NDArray[np.floating], count: int = 36) -> list[View]:
    """Return views without photos around points, [N, 3]: a horizontal circle that begins at the viewer's start view."""
    viewpoint = Viewpoint.from_points(points, (), None)
    offset, views = viewpoint.start.position - viewpoint.pivot, []
    for i, angle in enumerate(2 * np.pi * np.arange(count) / count):
        cosine, sine = np.cos(angle), np.sin(angle)
        turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])  # about y, which is up or down
        eye = viewpoint.pivot + turn @ offset
        views.append(View.looking_at(eye, viewpoint.pivot, viewpoint.up, START_CAMERA, f"circle_{i:02d}"))
    return views


def up_direction(views: Sequence[View]) -> NDArray[np.float64]:
    """Return the up direction as a unit vector, [3].

    If the cameras are level and have different directions, it is perpendicular to their right axes.  Otherwise it is
    the mean of their up axes, which is tilted if all cameras look down from one side.  If the up axes cancel out, it is
    opposite to the mean viewing direction.
    """
    poses = np.stack([view.world_to_camera for view in views]).astype(np.float64)
    right, up, forward = poses[:, 0, :3], -poses[:, 1, :3].mean(axis=0), poses[:, 2, :3].mean(axis=0)
    squares, axes = np.linalg.eigh(right.T @ right / len(right))
    axis, length = axes[:, 0], np.linalg.norm(up)
    is_tilted = length > MIN_AGREEMENT and abs(axis @ up) < length * np.cos(np.radians(MAX_TILT))
    if squares[1] >= MIN_TURN and squares[0] <= MAX_ROLL * squares[1] and not is_tilted:
        sign = axis @ up if abs(axis @ up) > MIN_UP else -axis @ forward  # cameras look down more often than up
        return np.asarray(axis if sign > 0 else -axis)
    axis = up if length > np.linalg.norm(forward) / 2 else -forward
    axis = axis if np.linalg.norm(axis) > np.finfo(np.float32).eps else -poses[0, 1, :3]
    return np.asarray(axis / np.linalg.norm(axis), np.float64)


MAX_SLOPE = np.radians(45)  # largest angle between the normal of a ground plane and the expected up direction
PLANES, PLANE_POINTS = 2000, 5000  # candidates, each through three points, and points to compare them with
THICKNESS = 0.015  # thickness of the ground, relative to the typical size of the points
MIN_GROUND = 0.1  # smallest fraction of the points on the ground
REFINEMENTS = 10


def ground_plane(points: NDArray[np.floating], up: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Return the unit normal of the ground, [3], and the height of the ground along the normal.

    The ground is the plane with the largest score: the number of points in the plane minus the number of points below.
    Only planes whose normal is within 45 degrees of the unit vector `up`, [3], are considered.  points: [N, 3].  Raises
    DataError if few points are on such a plane.
    """
    rng = np.random.default_rng(0)
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    points = points[rng.permutation(len(points))[:PLANE_POINTS]]
    if len(points) < 3:
        raise DataError(f"there are too few points to find the ground; {NO_GROUND}")
    center, thickness = np.median(points, axis=0), THICKNESS * typical_size(points)
    points = points - center
    a, b, c = points[rng.integers(len(points), size=(3, PLANES))]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    cosines = normals @ up
    is_level = np.abs(cosines) >= np.cos(MAX_SLOPE)
    normals, a = (normals * np.sign(cosines)[:, None])[is_level], a[is_level]
    if not len(normals):
        raise DataError(f"no plane through the points is within 45 degrees of level; {NO_GROUND}")
    heights = normals @ points.T - (normals * a).sum(axis=1, keepdims=True)
    scores = (np.abs(heights) < thickness).sum(axis=1) - (heights < -3 * thickness).sum(axis=1)
    normal, height = normals[scores.argmax()], float(normals[scores.argmax()] @ a[scores.argmax()])
    for _ in range(REFINEMENTS):
        ground = points[np.abs(points @ normal - height) < 2 * thickness]
        if len(ground) < max(3, MIN_GROUND * len(points)) or normal @ up < np.cos(MAX_SLOPE):
            raise DataError(f"only {len(ground) / len(points):.1%} of the points are on a level plane; {NO_GROUND}")
        axis = np.linalg.svd(ground - ground.mean(axis=0), full_matrices=False)[2][2]
        normal = axis if axis @ normal > 0 else -axis
        height = float(normal @ ground.mean(axis=0))
    return normal, height + float(normal @ center)


def perpendicular(up: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return a unit vector, [3], that is perpendicular to the unit vector `up`, [3]."""
    vector = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def nearest_to_axes(
    centers: NDArray[np.floating], axes: NDArray[np.floating], prior: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the point, [3], with the smallest sum of squared distances to V lines, with a small weight for `prior`.

    centers, axes: a point on each line and the unit direction of the line, [V, 3].
    """
    planes = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weight = PRIOR * len(centers)
    matrix = planes.sum(axis=0) + weight * np.eye(3)
    return np.asarray(np.linalg.solve(matrix, np.einsum("vij,vj->i", planes, centers) + weight * prior))


BLENDER_DISTANCE = 4.03  # distance of the cameras from the center in the Blender scenes
RANDOM_BOX = 1.3 / BLENDER_DISTANCE  # half the side of the box / camera distance (3DGS, Kerbl et al. 2023)
MIN_DISTANCE = 1e-3  # in extents; cameras nearer to the center only rotate


def random_points(scene: Scene, count: int, seed: int) -> PointCloud:
    """Return `count` gray points, distributed uniformly in a box around the point that the training cameras look at."""
    center, half_side = scene_box(scene)
    rng = np.random.default_rng([seed, count])
    spread = rng.uniform(-half_side, half_side, (count, 3))
    return PointCloud((center + spread).astype(np.float32), np.full((count, 3), 127 / 255, np.float32))


def scene_box(scene: Scene) -> tuple[NDArray[np.floating], float]:
    """Return the center, [3], and half the side of a box around the point that the training cameras look at."""
    return scene_center(scene.split("train")), RANDOM_BOX * camera_distance(scene)


def camera_distance(scene: Scene) -> float:
    """Return the median distance of the training cameras from the point that they look at, scene units.

    For cameras that only rotate, it is the extent.
    """
    views = scene.split("train")
    positions, center = np.stack([view.position for view in views]), scene_center(views)
    distance = float(np.median(np.linalg.norm(positions - center, axis=1)))
    return distance if distance > MIN_DISTANCE * scene.extent else scene.extent


def scene_center(views: Sequence[View]) -> NDArray[np.floating]:
    """Return the point that the cameras look at, nearest to all optical axes in least squares, [3] scene units."""
    positions, directions = np.stack([v.position for v in views]), np.stack([v.world_to_camera[2, :3] for v in views])
    planes = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point, *_ = np.linalg.lstsq(planes.sum(axis=0), np.einsum("nij,nj->i", planes, positions), rcond=None)
    return np.asarray(point)
