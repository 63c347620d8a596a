"""Read camera paths from files: nerfstudio's camera_path.json, and the cameras.json of 3DGS.

A camera_path.json contains render_width and render_height (px), fps, seconds, camera_type (perspective), and
camera_path, which has one entry per frame: camera_to_world (16 values, row-major, OpenGL axes), fov (degrees,
vertical), aspect, and render_time (0 to 1, in a dynamic scene).
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from clsplat.core.errors import ConfigError, DataError, quote
from clsplat.core.reading import read_json
from clsplat.formats.splats import is_timestamp
from clsplat.scene import camera_files
from clsplat.scene.camera import Camera
from clsplat.scene.transforms_json import TRANSFORMS_FILE as TRANSFORMS
from clsplat.scene.transforms_json import JsonFrame, read_pose
from clsplat.scene.view import View
from clsplat.viewer.video.paths import (
    MAX_FRAMES,
    Floats,
    Size,
    center_inside,
    check_fps,
    check_size,
    even_size,
    fit_inside,
)

LOG = logging.getLogger("clsplat")
WORLD = "dataparser_transforms.json"  # next to a path file: how nerfstudio transformed the scene
MAX_BYTES = 1 << 27


@dataclass(frozen=True)
class CameraPath:
    """A camera path read from a file."""

    views: list[View]
    fps: float
    size: Size  # px

    def resized(self, size: Size) -> list[View]:
        """Return the views at another size, with the same vertical field of view."""
        scale = size[1] / self.size[1]
        return [replace(view, camera=center_inside(view.camera, size, scale)) for view in self.views]


def read(path: Path, scene: Path | None = None) -> CameraPath:
    """Read a camera path, and transform its poses to the coordinates of a scene folder.

    nerfstudio transforms a scene, and writes the transform to the file WORLD.  If WORLD is not next to the path, the
    poses are used unchanged, and a warning is logged.
    Raises DataError for other files, invalid values, and cameras that are not perspective.
    """
    data = read_json(path, "a camera_path.json of nerfstudio, or a cameras.json of 3DGS", limit=MAX_BYTES)
    if isinstance(data, list):
        return _read_cameras(path)
    frames = data.get("camera_path") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(
            f"{path}: expected a JSON object with a list `camera_path`, as in a path of nerfstudio; export it again"
        )
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise DataError(f"{path}: has {len(frames)} frames; expected 1 to {MAX_FRAMES}")
    if (camera_type := data.get("camera_type", "perspective")) != "perspective":
        raise DataError(f"{path}: camera_type is {quote(camera_type)}; expected perspective; export the path again")
    size, fps = _read_size_and_rate(JsonFrame(path.parent, str(path), data))
    to_scene = _make_world_transform(path, scene)
    views = []
    for i, entry in enumerate(frames):
        frame = JsonFrame(path.parent, f"{path}: camera_path[{i}]", entry)
        fov = frame.number("fov")
        if fov is None or not 0.01 <= fov < 179:
            raise DataError(f"{frame.source}: fov is {quote(fov)}; expected 0.01 to 179 degrees; export the path again")
        matrix = {"transform_matrix": _to_rows(entry.get("camera_to_world"))}
        pose = np.linalg.inv(read_pose(JsonFrame(path.parent, frame.source, matrix)))[:3]
        time = frame.number("render_time")
        if time is not None and not is_timestamp(time):
            raise DataError(f"{frame.source}: render_time is {time:g}; expected 0 to 1; export the path again")
        views.append(View(f"frame_{i + 1:05d}", _make_camera(size, math.radians(fov)), to_scene(pose), time=time))
    return CameraPath(views, fps, size)


def _read_cameras(path: Path) -> CameraPath:
    """Read a path from a cameras.json; all frames get the size of the first camera."""
    views = camera_files.read_inria(path)
    size = even_size(views[0].camera)
    frames = [
        replace(view, name=f"frame_{i:05d}", camera=fit_inside(view.camera, size)) for i, view in enumerate(views, 1)
    ]
    return CameraPath(frames, 30.0, size)


def resample(views: Sequence[View], frames: int) -> list[View]:
    """Return evenly spaced views along a path, with interpolated positions, rotations (slerp), and intrinsics.

    Timestamps are interpolated too if all views have one.
    """
    if frames == len(views):
        return list(views)
    if len(views) == 1:
        return [replace(views[0], name=f"frame_{i:05d}") for i in range(1, frames + 1)]
    positions = np.linspace(0, len(views) - 1, frames)
    poses = np.stack([view.world_to_camera for view in views])
    rotations = scipy.spatial.transform.Slerp(
        np.arange(len(views)), scipy.spatial.transform.Rotation.from_matrix(poses[:, :, :3])
    )(positions).as_matrix()
    lenses = np.array([[c.fx, c.fy, c.cx, c.cy] for c in (view.camera for view in views)])
    centers, lenses = (
        np.stack([np.interp(positions, np.arange(len(views)), column) for column in columns.T], axis=1)
        for columns in (np.stack([view.position for view in views]), lenses)
    )
    timestamps = [view.time for view in views if view.time is not None]
    has_times = len(timestamps) == len(views)
    times = np.interp(positions, np.arange(len(views)), timestamps).tolist() if has_times else [None] * frames
    camera = views[0].camera
    return [
        View(
            f"frame_{i:05d}",
            Camera(camera.width, camera.height, *lens),
            np.column_stack([rotation, -rotation @ center]),
            time=time,
        )
        for i, (rotation, center, lens, time) in enumerate(
            zip(rotations, centers, lenses.tolist(), times, strict=True), 1
        )
    ]


def _make_camera(size: Size, fov: float) -> Camera:
    """Return a camera with this image size and vertical field of view, rad."""
    focal = size[1] / 2 / math.tan(fov / 2)
    return Camera(*size, focal, focal, size[0] / 2, size[1] / 2)


def _read_size_and_rate(document: JsonFrame) -> tuple[Size, float]:
    """Return the frame size, rounded down to even sides, and the frames per second, or defaults if they are missing."""
    sides, fps = [document.number(key) for key in ("render_width", "render_height")], document.number("fps")
    width, height = (1280, 720) if sides == [None, None] else (int(side or 0) // 2 * 2 for side in sides)
    try:
        return check_size((width, height)), check_fps(30.0 if fps is None else fps)
    except ConfigError as error:
        raise DataError(f"{document.source}: {error}; export the path again") from error


def _to_rows(values: Any) -> Any:
    """Reshape 16 values to four rows.  Any other value is returned unchanged, and the caller rejects it."""
    if not isinstance(values, list) or len(values) != 16:
        return values
    return [values[i : i + 4] for i in range(0, 16, 4)]


def _make_world_transform(path: Path, scene: Path | None) -> Any:
    """Return a function that transforms world-to-camera poses, [3, 4], to the coordinates of the scene."""
    file = path.parent / WORLD
    if not file.is_file():
        LOG.warning(
            "%s: poses are used as scene coordinates; if nerfstudio transformed the scene, put %s next to this file",
            *(path, WORLD),
        )
        return lambda pose: pose
    matrix, scale = _read_affine(file)
    rotation, translation = matrix[:, :3], matrix[:, 3]
    applied_transform = _read_applied_transform(scene)

    @np.errstate(all="ignore")  # poses that are not finite are rejected later
    def to_scene(pose: Floats) -> Floats:
        """Invert x' = scale · (rotation x + translation), nerfstudio's transform."""
        center = -pose[:, :3].T @ pose[:, 3]
        scene_rotation = pose[:, :3] @ rotation @ applied_transform[:, :3].T
        position = applied_transform[:, :3] @ (rotation.T @ (center / scale - translation)) + applied_transform[:, 3]
        return np.column_stack([scene_rotation, -scene_rotation @ position])

    return to_scene


def _read_affine(file: Path) -> tuple[Floats, float]:
    """Read the rotation and translation, [3, 4], and the scale from a WORLD file.  Raises DataError."""
    data = read_json(file, "a rotation and a scale in JSON", limit=MAX_BYTES)
    frame = JsonFrame(file.parent, str(file), data if isinstance(data, dict) else {})
    matrix, scale = _read_rigid(frame, "transform"), frame.number("scale")
    if scale is None or not scale > 0:
        raise DataError(f"{file}: scale is {quote(scale)}; expected a number above 0; export the file again")
    return matrix, scale


def _read_rigid(frame: JsonFrame, key: str) -> Floats:
    """Read a rotation and a translation, [3, 4].  Raises DataError."""
    try:
        matrix = np.array(frame.value(key), np.float64)[:3]
    except (ValueError, TypeError, OverflowError, IndexError):
        matrix = np.empty(0)
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:, :3]) - 1) > 1e-3:
        raise DataError(f"{frame.source}: {key} is not a 3x4 matrix with a rotation; export the file again")
    return matrix


def _read_applied_transform(scene: Path | None) -> Floats:
    """Return the transform, [3, 4], that nerfstudio applied to poses in transforms.json; by default the identity."""
    file = scene / TRANSFORMS if scene else None
    if file is None or not file.is_file():
        return np.eye(3, 4)
    data = read_json(file, "cameras in JSON", limit=MAX_BYTES)
    frame = JsonFrame(file.parent, str(file), data if isinstance(data, dict) else {})
    return np.eye(3, 4) if frame.value("applied_transform") is None else _read_rigid(frame, "applied_transform")
