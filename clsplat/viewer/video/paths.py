"""Generate camera paths around and through a scene, by name.

Each path is a function of a rig, a number of frames, and a size, and returns one view per frame.
"""

import logging
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, quote
from clsplat.scene.camera import Camera
from clsplat.scene.scene import outlier_cameras
from clsplat.scene.view import View
from clsplat.scene.viewpoint import nearest_to_axes, up_direction

# The input of a camera path: the cameras of the photos, their focus, and the up direction.

Floats = NDArray[np.floating]
MAX_POINTS = 20_000  # number of points sampled for near and far
QUANTILES = 0.05, 0.95  # of the visible depths, for near and far
PARALLEL = 0.9  # length of the mean view direction above which the axes are too parallel for a focus
DEPTH_MARGIN = 1.5  # factor for near and far; a focus of parallel axes outside of these bounds is replaced
MIN_FACING = 0.5  # minimum fraction of cameras with the focus in front of them


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene, without outliers, and points of the visible content."""

    views: Sequence[View]
    points: Floats  # [M, 3], the means of a model or the points of a scene

    @classmethod
    def from_views(cls, views: Sequence[View], points: Floats) -> "Rig":
        """Return a rig without outlier cameras or non-finite points.  Raises DataError if there is no view."""
        if not views:
            raise DataError("a camera path needs the cameras of a scene, but this scene has none; use another scene")
        is_outlier = outlier_cameras(views)
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        stride = -(-len(points) // MAX_POINTS) or 1
        return cls([view for view, is_far in zip(views, is_outlier, strict=True) if not is_far], points[::stride])

    @cached_property
    def positions(self) -> Floats:
        """Camera centers, [V, 3]."""
        return np.stack([view.position for view in self.views])

    @cached_property
    def forwards(self) -> Floats:
        """View directions, [V, 3], unit."""
        return np.stack([view.world_to_camera[2, :3] for view in self.views])

    @cached_property
    def ups(self) -> Floats:
        """Up vectors of the images, [V, 3]."""
        return np.stack([-view.world_to_camera[1, :3] for view in self.views])

    @cached_property
    def up(self) -> Floats:
        """The up direction of the scene, [3], unit."""
        return up_direction(self.views)

    @cached_property
    def focus(self) -> Floats:
        """The point nearest to the optical axes, [3]; for almost parallel axes, a point at half the depth range.

        Raises DataError if most cameras look away from it.
        """
        center = np.median(self.points, axis=0) if len(self.points) else self.positions.mean(axis=0)
        focus = nearest_to_axes(self.positions, self.forwards, center)
        forward, (near, far) = self.forwards.mean(axis=0), self.depths
        depth = float(np.median(self._point_depths(focus)))
        if np.linalg.norm(forward) > PARALLEL and not near / DEPTH_MARGIN < depth < far * DEPTH_MARGIN:
            focus = self.positions.mean(axis=0) + normalize(forward) * (near + far) / 2
        if (self._point_depths(focus) > 0).mean() < MIN_FACING:
            raise DataError(
                "the cameras look away from each other, so there is no center to orbit; use the path `through`"
            )
        return focus

    def _point_depths(self, point: Floats) -> Floats:
        """Return the depth of a point in each view, [V]."""
        return np.asarray(((point - self.positions) * self.forwards).sum(axis=1))

    @cached_property
    def depths(self) -> tuple[float, float]:
        """The near and far depths in scene units, which are quantiles of the visible depths."""
        view_depths = [self._visible_depths(view) for view in self.views[:: -(-len(self.views) // 64)]]
        depths = np.concatenate(view_depths)
        if not len(depths):
            return 1.0, 10.0
        near, far = np.quantile(depths, QUANTILES)
        return float(near), float(far)

    def _visible_depths(self, view: View) -> Floats:
        """Return the depths of the points in a view's image."""
        x, y, z = view.world_to_camera[:, :3] @ self.points.T + view.world_to_camera[:, 3:]
        c = view.camera
        with np.errstate(all="ignore"):
            u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
        is_inside = (z > 0) & (u >= 0) & (v >= 0) & (u < c.width) & (v < c.height)
        return np.asarray(z[is_inside])

    @cached_property
    def camera(self) -> Camera:
        """The camera with the median field of view."""
        cameras = sorted((view.camera for view in self.views), key=lambda c: c.width * c.height / (c.fx * c.fy))
        return cameras[len(cameras) // 2]


def normalize(vectors: Floats) -> Floats:
    """Normalize vectors, [..., 3]."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


# A tour of the views of a scene: their order, and a smooth curve along them.

Indices = NDArray[np.intp]
DEGREE = 5  # of the B-spline
SMOOTHING = 0.25  # distance of the curve from a view, relative to the median step between consecutive views
UP_WEIGHT = 0.1  # weight of up vectors relative to positions, multiplied by the distance of the target
MAX_VIEWS = 1000  # in a tour, evenly sampled by name
ROUNDS = 20  # of 2-opt


def tour_order(rig: Rig) -> Indices:
    """Return the indices of the views, [V], sorted by name, or as a nearest-neighbor tour if that is shorter."""
    spread = float(np.median(np.linalg.norm(rig.positions - np.median(rig.positions, axis=0), axis=1))) or 1.0
    features = np.hstack([rig.positions / spread, rig.forwards])
    by_name = np.array(sorted(range(len(rig.views)), key=lambda i: rig.views[i].name))
    by_name = by_name[:: -(-len(by_name) // MAX_VIEWS)]
    distances = scipy.spatial.distance.cdist(features[by_name], features[by_name])
    tours = np.arange(len(by_name)), _shorten(_nearest_neighbor_tour(distances), distances)
    return np.asarray(by_name[min(tours, key=lambda tour: _length(tour, distances))])


def smooth(poses: Floats, frames: int, distance: float) -> Floats:
    """Return evenly spaced samples of a B-spline of degree 5 near the poses, [frames, 9].

    poses: [V, 9], each a position, a target at `distance` from the position, and an up vector.
    """
    weights = np.repeat([1.0, 1.0, UP_WEIGHT * distance], 3)
    weighted_poses = poses * weights
    steps = np.linalg.norm(np.diff(weighted_poses, axis=0), axis=1)
    is_new = np.append(True, steps > 1e-9 * max(1e-30, float(steps.max(initial=0.0))))  # drop repeated poses
    weighted_poses = weighted_poses[is_new]
    if len(weighted_poses) == 1:
        return np.repeat(poses[:1], frames, axis=0)
    smoothing = len(weighted_poses) * (SMOOTHING * float(np.median(steps[is_new[1:]]))) ** 2
    curve, _ = scipy.interpolate.splprep(
        weighted_poses.T, k=min(DEGREE, len(weighted_poses) - 1), s=smoothing if len(weighted_poses) > DEGREE else 0
    )
    return np.asarray(np.stack(scipy.interpolate.splev(np.linspace(0, 1, frames), curve), axis=1) / weights)


def _nearest_neighbor_tour(distances: Floats) -> Indices:
    """Return a tour that starts at the first view and continues to the nearest unvisited view each time."""
    tour, unvisited_views = [0], set(range(1, len(distances)))
    while unvisited_views:
        candidates = np.array(sorted(unvisited_views))
        tour.append(int(candidates[distances[tour[-1], candidates].argmin()]))
        unvisited_views.remove(tour[-1])
    return np.array(tour)


def _shorten(tour: Indices, distances: Floats) -> Indices:
    """Shorten a tour in place by reversing parts of it (2-opt)."""
    for _ in range(ROUNDS):
        has_improved = False
        for i in range(len(tour) - 2):
            steps = np.append(distances[tour[i + 2 : -1], tour[i + 3 :]], 0.0)  # nothing follows the last view
            ends = np.append(distances[tour[i + 1], tour[i + 3 :]], 0.0)
            gain = distances[tour[i], tour[i + 1]] + steps - distances[tour[i], tour[i + 2 :]] - ends
            j = int(gain.argmax())
            if gain[j] > 1e-9:
                tour[i + 1 : i + 3 + j] = tour[i + 1 : i + 3 + j][::-1].copy()
                has_improved = True
        if not has_improved:
            break
    return tour


def _length(tour: Indices, distances: Floats) -> float:
    return float(distances[tour[:-1], tour[1:]].sum())


# Cameras with the frame size of a video.

SIDES = 16, 8192  # px, smallest and largest side of a frame
MAX_FRAMES = 100_000
RATES = 1, 240  # frames per second
Size = tuple[int, int]  # width, height


def check_size(size: str | Size) -> Size:
    """Parse a frame size: text such as 640x480, or width and height.

    Raises ConfigError unless both sides are even, as codecs require, and within bounds.
    """
    if isinstance(size, str):
        match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", size.strip().lower())
        sides = (int(match[1]), int(match[2])) if match else None
    else:
        sides = (size[0], size[1]) if len(size) == 2 and all(isinstance(side, int) for side in size) else None
    if sides is None or not SIDES[0] <= min(sides) <= max(sides) <= SIDES[1] or sides[0] % 2 or sides[1] % 2:
        raise ConfigError(
            f"size {quote(size)}: expected WIDTHxHEIGHT in even numbers from {SIDES[0]} to {SIDES[1]}, such as 640x480"
        )
    return sides


def validate_size(text: str) -> str:
    """Return a frame size unchanged.  Raises ValueError, as a validator must, if the size is invalid."""
    try:
        check_size(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return text


def check_frames(frames: int) -> int:
    """Return a number of frames unchanged.  Raises ConfigError if it is out of bounds."""
    if isinstance(frames, bool) or not isinstance(frames, int) or not 1 <= frames <= MAX_FRAMES:
        raise ConfigError(f"frames {quote(frames)}: expected a whole number from 1 to {MAX_FRAMES}")
    return frames


def check_fps(fps: float) -> float:
    """Return frames per second unchanged.  Raises ConfigError if they are out of bounds."""
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not RATES[0] <= fps <= RATES[1]:
        raise ConfigError(f"fps {quote(fps)}: expected frames per second from {RATES[0]} to {RATES[1]}")
    return fps


def even_size(camera: Camera) -> Size:
    """Return the size of a camera's image with even sides, scaled down if it exceeds the maximum size of a video."""
    factor = min(1.0, SIDES[1] / max(camera.width, camera.height))
    width, height = (max(SIDES[0], int(side * factor) // 2 * 2) for side in (camera.width, camera.height))
    return width, height


def same_area(camera: Camera, size: Size) -> Camera:
    """Return a camera with another image size, a centered principal point, and a field of view of the same area."""
    width, height = size
    scale = math.sqrt(width * height / (camera.width * camera.height))
    return Camera(width, height, camera.fx * scale, camera.fy * scale, width / 2, height / 2)


def fit_inside(camera: Camera, size: Size) -> Camera:
    """Return a camera of another image size that shows the entire original image at the center."""
    return center_inside(camera, size, fit_scale(camera, size))


def center_inside(camera: Camera, size: Size, scale: float) -> Camera:
    """Return a camera of another image size that shows the original image at the center, scaled by `scale`."""
    width, height = size
    left, top = (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
    return Camera(
        width, height, camera.fx * scale, camera.fy * scale, scale * camera.cx + left, scale * camera.cy + top
    )


def fit_scale(camera: Camera, size: Size) -> float:
    """Return the scale at which a camera's image just fits into another size."""
    return min(size[0] / camera.width, size[1] / camera.height)


LOG = logging.getLogger("clsplat")
MAX_GAP = math.radians(100)  # between adjacent cameras on a ring around the focus; wider gaps were not photographed
PERCENTILE = 90  # of the cameras' offsets, for the half axes (Barron et al. 2022)
FOCUS_DEPTH = 0.75  # of a spiral, from near (0) to far (1) in inverse depth (Mildenhall et al. 2019)
TURNS = 2  # of a spiral
MAX_RADIUS = 0.3  # of a spiral, relative to the distance of its target; cameras may surround the scene
ARC_FRACTION = 0.85  # of a photographed arc; at its ends, half of the image was not photographed
TIME_WEIGHT = 1e-3  # cost of the full time range if a right angle costs 1; selects among views of one camera
MIN_AGREEMENT = 0.5  # length of the mean view direction below which the cameras have no common front


def ellipse(rig: Rig, frames: int, size: Size) -> list[View]:
    """Circle the focus on an ellipse that fits the cameras, or swing back and forth if they are all on one side.

    The half axes are the 90th percentiles of the cameras' offsets from the focus along their horizontal principal axes,
    as in Mip-NeRF 360 (Barron et al. 2022).  The height is the mean height of the cameras.
    """
    axes, offsets, height = _ring_axes(rig)
    half_axes = np.percentile(np.abs(offsets), PERCENTILE, axis=0)
    if min(half_axes) <= 1e-6 * max(half_axes):
        half_axes = np.maximum(half_axes, 0.05 * max(half_axes, default=0.0))
    angles = _sweep_angles(np.arctan2(offsets[:, 1] / half_axes[1], offsets[:, 0] / half_axes[0]), frames)
    plane_offsets = np.stack([half_axes[0] * np.cos(angles), half_axes[1] * np.sin(angles)], axis=1)
    return _look_at(rig, rig.focus + plane_offsets @ axes + height.mean() * rig.up, rig.focus, size)


def orbit(rig: Rig, frames: int, size: Size) -> list[View]:
    """Circle the focus once at the cameras' median distance and height, like a turntable."""
    axes, offsets, height = _ring_axes(rig)
    radius = float(np.median(np.linalg.norm(offsets, axis=1)))
    camera_angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    if (gap := _widest_gap(camera_angles)[0]) > MAX_GAP:
        LOG.warning(
            "no photos were taken along %.0f degrees of the orbit; the path `ellipse` stays where photos were taken",
            math.degrees(gap),
        )
    angles = camera_angles[0] + 2 * np.pi * np.arange(frames) / frames
    plane_offsets = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return _look_at(rig, rig.focus + plane_offsets @ axes + np.median(height) * rig.up, rig.focus, size)


def spiral(rig: Rig, frames: int, size: Size) -> list[View]:
    """Circle the mean camera position twice, looking at one point, for forward-facing scenes.

    The formulas are from Local Light Field Fusion (Mildenhall et al. 2019).
    """
    forward, center = rig.forwards.mean(axis=0), rig.positions.mean(axis=0)
    if np.linalg.norm(forward) < MIN_AGREEMENT:
        raise DataError("the cameras look in many directions, so a spiral has no front; use ellipse or through")
    forward = normalize(forward)
    right = normalize(np.cross(forward, rig.up))
    axes = np.stack([right, np.cross(forward, right), forward])
    near, far = rig.depths
    target = center + forward / ((1 - FOCUS_DEPTH) / near + FOCUS_DEPTH / far)
    radii = np.percentile(np.abs((rig.positions - center) @ axes.T), PERCENTILE, axis=0)
    radii *= min(1.0, MAX_RADIUS * float(np.linalg.norm(target - center)) / max(float(radii.max()), 1e-30))
    turn = 2 * np.pi * TURNS * np.arange(frames) / frames
    steps = np.stack([np.cos(turn), np.sin(turn), np.sin(turn / 2)], axis=1) * radii
    positions = center + steps @ axes
    return look_at_targets(
        positions, np.broadcast_to(target, positions.shape), np.broadcast_to(rig.up, positions.shape), rig, size
    )


def fly_through(rig: Rig, frames: int, size: Size) -> list[View]:
    """Fly along the views on a smooth curve, in order of name or as a nearest-neighbor tour, whichever is shorter."""
    order = tour_order(rig)
    distance = float(np.median(rig.depths))
    keyframes = np.hstack([rig.positions, rig.positions + distance * rig.forwards, rig.ups])[order]
    track = smooth(keyframes, frames, distance)
    return look_at_targets(track[:, :3], track[:, 3:6], track[:, 6:], rig, size)


def select_views(rig: Rig, frames: int, size: Size) -> list[View]:
    """Return at most `frames` of the views, at even intervals in their order, with their images fitted into `size`."""
    indices = np.unique(np.linspace(0, len(rig.views) - 1, min(frames, len(rig.views))).round().astype(int))
    return [
        replace(rig.views[i], camera=fit_inside(rig.views[i].camera, size), lens=None, mask_path=None) for i in indices
    ]


def stay_at_center(rig: Rig, frames: int, size: Size) -> list[View]:
    """Stay at the most central camera, for moving scenes."""
    center = np.median(rig.positions, axis=0)
    return repeat_view(rig.views[int(np.linalg.norm(rig.positions - center, axis=1).argmin())], frames, size)


def repeat_view(view: View, frames: int, size: Size) -> list[View]:
    """Repeat a view for all frames, without its timestamp."""
    frame = replace(view, camera=fit_inside(view.camera, size), lens=None, mask_path=None, time=None)
    return [replace(frame, name=f"frame_{i:05d}") for i in range(1, frames + 1)]


PATHS: dict[str, Callable[[Rig, int, Size], list[View]]] = {
    "ellipse": ellipse,
    "spiral": spiral,
    "orbit": orbit,
    "through": fly_through,
    "views": select_views,
    "fixed": stay_at_center,
}


def look_at_targets(positions: Floats, targets: Floats, ups: Floats, rig: Rig, size: Size) -> list[View]:
    """Return one view per position, which looks at the target in the same row.

    positions, targets, ups: [F, 3] each.  Raises DataError if a view direction is parallel to its up vector.
    """
    camera = same_area(rig.camera, size)
    try:
        return [
            View.looking_at(position, target, up, camera, f"frame_{i:05d}")
            for i, (position, target, up) in enumerate(zip(positions, targets, ups, strict=True), 1)
        ]
    except ValueError as error:
        raise DataError(f"this path is impossible with these cameras: {error}; use another --path") from error


def _ring_axes(rig: Rig) -> tuple[Floats, Floats, Floats]:
    """Return the horizontal principal axes of the cameras, [2, 3], and the cameras' offsets from the focus.

    The offsets are along the two axes, [V, 2], and along up, [V].
    """
    offsets = rig.positions - rig.focus
    heights = offsets @ rig.up
    flat = offsets - heights[:, None] * rig.up
    _, vectors = np.linalg.eigh(flat.T @ flat + 1e6 * float((flat**2).sum() + 1e-30) * np.outer(rig.up, rig.up))
    main_axis = vectors[:, 1] * (1.0 if vectors[:, 1] @ offsets[0] >= 0 else -1.0)
    axes = np.stack([main_axis, np.cross(rig.up, main_axis)])
    return axes, flat @ axes.T, heights


def _sweep_angles(angles: Floats, frames: int) -> Floats:
    """Return the angle of each frame: a full turn, or a swing back and forth if the cameras leave a wide gap.

    angles: of the cameras, [V], rad.
    """
    gap, start = _widest_gap(angles)
    phase = 2 * np.pi * np.arange(frames) / frames
    if gap < MAX_GAP:
        return np.asarray(angles[0] + phase)
    half_arc = np.pi - gap / 2
    return np.asarray(start + half_arc + ARC_FRACTION * half_arc * np.sin(phase))


def _widest_gap(angles: Floats) -> tuple[float, float]:
    """Return the widest angle without a camera, and the angle of the camera after it, in radians."""
    ring = np.sort(angles % (2 * np.pi))
    gaps = np.diff(np.append(ring, ring[0] + 2 * np.pi))
    index = int(gaps.argmax())
    return float(gaps[index]), float(ring[(index + 1) % len(ring)])


def _look_at(rig: Rig, positions: Floats, target: Floats, size: Size) -> list[View]:
    targets, ups = (np.broadcast_to(vector, positions.shape) for vector in (target, rig.up))
    return look_at_targets(positions, targets, ups, rig, size)


def nearest_view(view: View, views: Sequence[View], reach: float) -> View:
    """Return the view whose camera is nearest.  A distance of `reach` counts as much as a rotation by 90 degrees.

    Among the views of one camera, the nearest in time is returned.
    """
    distance = np.array([np.linalg.norm(view.position - other.position) for other in views]) / reach
    angle = np.array([1 - view.world_to_camera[2, :3] @ other.world_to_camera[2, :3] for other in views])
    time_gap = np.array([abs((view.time or 0.0) - (other.time or 0.0)) for other in views])
    return views[int((distance + angle + TIME_WEIGHT * time_gap).argmin())]
