"""Read datasets with cameras in JSON: Blender (NeRF), nerfstudio, and multi-scale Blender (mip-NeRF)."""

import logging
import math
import os
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from clsplat.core.errors import DataError, quote
from clsplat.core.reading import read_json
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Camera, Lens, intern_lens, panorama_lens
from clsplat.scene.images import read_stored_size
from clsplat.scene.lookup import FileLookup, Missing, describe_unsupported_cameras, safe_join
from clsplat.scene.points import BELOW_MAX, MAX_VALUE, read_ply_table, read_points_ply
from clsplat.scene.reader import Parts, Reader
from clsplat.scene.scene import Background, PointCloud, Scene, every_nth, make_scene
from clsplat.scene.times import Clock, make_clock
from clsplat.scene.view import Floats, View, fit_to_photograph

POINTS_FILE = "points3d.ply"
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
LENSES = {  # the parameters of each camera_model, in COLMAP's order
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), DISTORTION[:4]),
    "FULL_OPENCV": DISTORTION,
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), ("k1", "k2", "k3", "k4")),
    "EQUIRECTANGULAR": (),
}
COLMAP_MODELS = {4: "OPENCV", 8: "FULL_OPENCV"}  # by number of distortion parameters
MAX_FRAMES = 100_000  # ten times the largest captures that are trained as one scene; reading takes about 15 s
MIN_SCALE = 1e-6  # smallest scale factor in the rotation of a pose
MAX_BYTES = 1 << 27  # exporters write at most 1.3 KB for a frame


class JsonFrame:
    """The values of one image in a file; values at the top level of the file are defaults.

    source: the file and the index of the frame, for messages.
    """

    def __init__(self, folder: Path, source: str, values: dict[str, Any], shared: dict[str, Any] | None = None) -> None:
        self.folder, self.source = folder, source
        self._values, self._defaults = values, shared or {}

    def value(self, key: str) -> Any:
        """Return the unchecked value of a key, or None if it is missing."""
        return self._values[key] if key in self._values else self._defaults.get(key)

    def array(self, key: str) -> Floats:
        """Return a list of numbers as an array of unchecked shape; any other value becomes an empty array."""
        try:
            return np.array(self.value(key), np.float64)
        except (ValueError, TypeError, OverflowError):
            return np.empty(0)

    def number(self, key: str) -> float | None:
        """Return a number of magnitude below MAX_VALUE, or None if it is missing.  Raises DataError otherwise."""
        value = self.value(key)
        if value is None:
            return None
        if isinstance(value, str):
            with suppress(ValueError):
                value = float(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_VALUE:
            raise DataError(f"{self.source}: {key} is {quote(value)}; expected {BELOW_MAX}: export the file again")
        return float(value)

    def file_name(self, key: str) -> str | None:
        """Return a path with forward slashes and no leading `./`, or None if it is missing.  Raises DataError."""
        value = self.value(key)
        if value is not None and not isinstance(value, str):
            raise DataError(f"{self.source}: {key} is {quote(value)}; expected a path below {self.folder}")
        return None if value is None else view_name(value)

    def image_name(self) -> str:
        """Return the path of the image, in the form of a view name.  Raises DataError when the frame has no path."""
        name = self.file_name("file_path")
        if name is None:
            raise DataError(f"{self.source}: has no `file_path`; expected the path of an image: export the file again")
        return name


class Transforms:
    """The content of a `transforms*.json`.  Raises DataError unless it is a JSON object with a list called `frames`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = read_json(path, "cameras in JSON", limit=MAX_BYTES)
        frames = self.table.get("frames") if isinstance(self.table, dict) else None
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise DataError(f"{path}: expected a JSON object with a list of objects named `frames`; export it again")
        if len(frames) > MAX_FRAMES:
            raise DataError(f"{path}: has {len(frames)} frames; expected at most {MAX_FRAMES}: split the scene")
        self.frames = [JsonFrame(path.parent, f"{path}: frames[{i}]", row, self.table) for i, row in enumerate(frames)]

    def timestamps(self) -> list[tuple[str, float | None]]:
        """Return the source and the `time` (None if missing) of every frame.  Raises DataError for invalid times."""
        return [(frame.source, frame.number("time")) for frame in self.frames]

    def read_points(self, clock: Clock | None = None) -> PointCloud | None:
        """Return the points, or None without a file of points.  Raises DataError like read_points_ply."""
        path = self.points_path()
        return read_points_ply(path, clock) if path else None

    def points_path(self) -> Path | None:
        """Return the path of the points: `ply_file_path`, else `points3d.ply` if it exists, else None."""
        name = JsonFrame(self.path.parent, str(self.path), self.table).file_name("ply_file_path")
        if name is not None:
            return safe_join(self.path.parent, name, str(self.path))
        default = self.path.parent / POINTS_FILE
        return default if default.is_file() else None


class FrameFiles(FileLookup):
    """The photographs and masks of the frames of a dataset in `folder`; the files are looked up below `root`."""

    def __init__(self, root: Path, folder: Path, frames: Sequence[JsonFrame]) -> None:
        super().__init__(root, folder, [frame.image_name() for frame in frames], _with_png)
        self.frames = frames
        self.masks: dict[str, dict[int, Path]] = {"mask_path": {}, "static_path": {}}  # by key and index of the frame

    def find_masks(self, source: Path, indices: Sequence[int]) -> None:
        """Find the masks of the frames with these indices.  Raises DataError when a mask is missing."""
        for key in self.masks:
            names = {i: name for i in indices if (name := self.frames[i].file_name(key))}
            files = FileLookup(self.root, self.folder, [*names.values()], strict=True, excluded=self.paths)
            files.existing_indices(source, "refuse")
            self.masks[key] = dict(zip(names, files.paths, strict=True))

    def make_views(self, source: Path, missing: Missing, clock: Clock | None = None) -> list[View]:
        """Return the views of the frames with photographs.

        missing: how to handle missing photographs.  Raises DataError for invalid values and missing files.
        """
        indices = self.existing_indices(source, missing)
        self.find_masks(source, indices)
        return [self.make_view(i, clock) for i in indices]

    def make_view(self, i: int, clock: Clock | None = None) -> View:
        """Return the view of the i-th frame; without a size in the frame, it has the size of its photograph.

        Photographs taken with a distorting lens are undistorted when they are read.  Raises DataError for invalid
        values.
        """
        frame, path, masks = self.frames[i], self.paths[i], [files.get(i) for files in self.masks.values()]
        size = None
        if not (frame.number("w") and frame.number("h")):
            try:
                size = read_stored_size(path)
            except DataError:  # decoding lists all damaged photographs
                size = self._first_size
        view = make_view(frame, self.names[i], size, clock)
        view = replace(view, image_path=path, mask_path=masks[0], static_path=masks[1])
        return fit_to_photograph(view) if path in self.downscaled_files else view

    def make_scene(
        self, path: Path, views: list[View], test: Set[str], points: PointCloud | None, background: Background = "black"
    ) -> Scene:
        """Return the scene at `path` with some views of the frames; test: the names of the test views."""
        test_indices = {i for i, view in enumerate(views) if view.name in test}
        return replace(make_scene(path, views, test_indices, points, background), skipped=self.skipped)

    @cached_property
    def _first_size(self) -> tuple[int, int]:
        """The size of the first readable photograph.  Raises DataError when all are unreadable."""
        for path in self.paths:
            with suppress(DataError):
                return read_stored_size(path)
        return read_stored_size(self.paths[0])


def _with_png(name: str) -> list[str]:
    """Return a file name with the suffix .png added if it has none, since Blender's exporter omits it."""
    return [name if PurePosixPath(name).suffix else f"{name}.png"]


def list_frames(parts: Parts, root: Path, *names: str) -> None:
    """Add to `parts` the frames of those files in `names` that exist, and the points of the first one."""
    files = [parts.attempt(Transforms, parts.path / name) for name in names if (parts.path / name).is_file()]
    timestamps = [time for file in filter(None, files) for time in parts.attempt(file.timestamps) or []]
    clock = parts.attempt(make_clock, parts.path, timestamps)
    frames = [frame for file in filter(None, files) for frame in file.frames]
    lookup = FrameFiles(root, parts.path, [frame for frame in frames if parts.attempt(frame.image_name)])
    parts.expect(lookup)
    if parts.scene is None:
        exists = [os.path.isfile(path) for path in lookup.paths]
        parts.attempt(lookup.find_masks, parts.path, np.flatnonzero(exists).tolist())
        for i, frame in enumerate(lookup.frames):
            has_size = exists[i] or (frame.value("w") and frame.value("h"))  # otherwise, only the file is a fault
            parts.views += filter(None, [parts.attempt(lookup.make_view, i, clock) if has_size else None])
    if files and files[0]:
        path = parts.attempt(files[0].points_path)
        parts.points = parts.attempt(read_ply_table, path) if path else None
        if parts.points and clock and len(parts.points.times):
            parts.attempt(clock.normalize_points, path, parts.points.times[parts.points.is_finite()])


def view_name(file_path: str) -> str:
    """Return the name of a view: its `file_path` with forward slashes and without a leading `./`."""
    return PureWindowsPath(file_path).as_posix()


def make_view(frame: JsonFrame, name: str, size: tuple[int, int] | None, clock: Clock | None = None) -> View:
    """Return the view of a frame without its photograph.

    size: (width, height) of the image, for a frame without a size.  clock: the clock of a dynamic scene.  Raises
    DataError for invalid values.
    """
    lens = intern_lens(make_lens(frame, _frame_camera(frame, size)))
    camera, distortion = (lens.pinhole, lens) if lens.has_distortion else (lens.camera, None)
    timestamp = frame.number("time")
    time = None if clock is None or timestamp is None else float(clock(timestamp))
    matrix = read_pose(frame)
    return View(name, camera, np.linalg.inv(matrix)[:3], lens=distortion, time=time, camera_to_world=matrix)


def _frame_camera(frame: JsonFrame, size: tuple[int, int] | None) -> Camera:
    """Return the camera of a frame without its distortion.  Raises DataError when it has no focal length."""
    width, height = (int(frame.number(key) or side) for key, side in zip("wh", size or (0, 0), strict=True))
    if frame.value("camera_model") == "EQUIRECTANGULAR" and 0 < min(width, height) <= max(width, height) <= MAX_SIDE:
        return panorama_lens(width, height).camera  # other programs write a meaningless focal length
    fx, fy = _read_focal(frame, "fl_x", "camera_angle_x", width), _read_focal(frame, "fl_y", "camera_angle_y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None or min(width, height) <= 0 or max(width, height) > MAX_SIDE or min(fx, fy) < MIN_FOCAL:
        focal = "no focal length" if fx is None or fy is None else f"focal lengths {fx:g}, {fy:g}"
        raise DataError(
            f"{frame.source}: the camera is {width}x{height} with {focal}; expected w and h from 1 to {MAX_SIDE}, and "
            "a positive fl_x, fl_y, or camera_angle_x; export the file again"
        )
    cx, cy = frame.number("cx"), frame.number("cy")
    return Camera(width, height, fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)


def _read_focal(frame: JsonFrame, length_key: str, angle_key: str, pixels: int) -> float | None:
    """Return a focal length in pixels, as given or from the field of view across `pixels`; None if both are missing."""
    length, angle = frame.number(length_key), frame.number(angle_key)
    degrees = frame.number(f"{angle_key[-1]}_fov")  # written by instant-ngp, in degrees
    if angle is None and degrees is not None:
        angle_key, angle = f"{angle_key[-1]}_fov", math.radians(degrees)
    if length is not None or angle is None:
        return length
    if not 0 < angle < math.pi:
        raise DataError(f"{frame.source}: {angle_key} is {angle}; expected an angle in (0, pi): export the file again")
    return pixels / 2 / math.tan(angle / 2)


def make_lens(frame: JsonFrame, camera: Camera) -> Lens:
    """Return the lens of a frame: OpenCV's polynomial, rational or fisheye model, or a panorama.

    Raises DataError for an unknown model, or for parameters that the model does not have.
    """
    model = frame.value("camera_model")
    model = "OPENCV_FISHEYE" if frame.value("is_fisheye") else "OPENCV" if model is None else model
    keys = LENSES.get(model) if isinstance(model, str) else None
    values = {key: frame.number(key) or 0.0 for key in DISTORTION}
    unsupported_keys = [key for key, value in values.items() if value and key not in (keys or DISTORTION)]
    if keys is None or unsupported_keys:
        fault = f"camera_model {quote(model)}" + (f" with {', '.join(unsupported_keys)}" if unsupported_keys else "")
        raise DataError(
            f"{frame.source}: {fault}; expected one of {', '.join(LENSES)} with its own parameters: "
            "export the cameras with one of these, or undistorted images with pinhole cameras"
        )
    params = (camera.fx, camera.fy, camera.cx, camera.cy, *(values[key] for key in keys))
    name = model if model == "EQUIRECTANGULAR" else "OPENCV_FISHEYE" if "FISHEYE" in model else COLMAP_MODELS[len(keys)]
    return Lens(camera.width, camera.height, name, params)


def read_pose(frame: JsonFrame) -> Floats:
    """Return the camera-to-world matrix of a frame, [4, 4], converted from OpenGL axes (y up, z back) to OpenCV axes.

    Raises DataError without a valid rotation.
    """
    matrix = frame.array("transform_matrix")
    is_finite = matrix.shape in ((4, 4), (3, 4)) and (np.abs(matrix) < MAX_VALUE).all()
    if is_finite and not _is_rotation(matrix[:3, :3]):
        matrix[:3, :3] /= np.cbrt(max(np.linalg.det(matrix[:3, :3]), MIN_SCALE**3))  # some exporters scale the rotation
    if not is_finite or not _is_rotation(matrix[:3, :3]):
        raise DataError(
            f"{frame.source}: transform_matrix is not a 4x4 matrix whose upper-left 3x3 block is a rotation; "
            "remove that frame or export the file again"
        )
    camera_to_world = np.eye(4)
    camera_to_world[:3] = matrix[:3]
    camera_to_world[:3, 1:3] *= -1
    return camera_to_world


def opengl_matrix(pose: Floats) -> Floats:
    """Return the camera-to-world matrix with OpenGL axes, [4, 4], of an OpenCV world-to-camera pose, [3, 4]."""
    matrix: Floats = np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]])) @ np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[3] = 0, 0, 0, 1
    return matrix


def _is_rotation(matrix: Floats) -> bool:
    """Return whether a [3, 3] matrix is a rotation up to 1e-3, since some exporters write few digits."""
    return np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0


# Read the Blender datasets of NeRF and D-NeRF: transforms_train.json and transforms_test.json.

TRAIN_FILE, TEST_FILE = "transforms_train.json", "transforms_test.json"


class BlenderReader(Reader):
    """Read a Blender scene.  The test views are those of transforms_test.json; without that file, there are none.

    With a `time` in every frame of both files, the scene is dynamic (D-NeRF): the first timestamp is 0, the last is 1.
    """

    name = "Blender"
    expects = TRAIN_FILE

    def matches(self, path: Path) -> bool:
        return (path / TRAIN_FILE).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        transforms = Transforms(path / TRAIN_FILE)
        test_transforms = Transforms(path / TEST_FILE) if (path / TEST_FILE).is_file() else None
        clock = make_clock(path, transforms.timestamps() + (test_transforms.timestamps() if test_transforms else []))
        files = FrameFiles(
            self.root or path, path, transforms.frames + (test_transforms.frames if test_transforms else [])
        )
        views = files.make_views(path if test_transforms else transforms.path, self.missing, clock)
        test = {*files.names[len(transforms.frames) :]}
        # NeRF and later papers render these scenes on white.
        return files.make_scene(path, views, test, transforms.read_points(clock), background="white")

    def list_parts(self, parts: Parts) -> None:
        list_frames(parts, self.root or parts.path, TRAIN_FILE, TEST_FILE)


# Read nerfstudio and instant-ngp datasets: one transforms.json.

TRANSFORMS_FILE = "transforms.json"
logger = logging.getLogger("clsplat")


class NerfstudioReader(Reader):
    """Read a nerfstudio scene, with its views in order of name.

    The lists `train_filenames` and `test_filenames` define the split if the file has one of them; images in neither
    list are omitted.  Otherwise, every `holdout`-th view is a test view.  If every frame has a `time`, the scene is
    dynamic.
    """

    name = "nerfstudio"
    expects = TRANSFORMS_FILE

    def matches(self, path: Path) -> bool:
        return (path / TRANSFORMS_FILE).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        transforms = Transforms(path / TRANSFORMS_FILE)
        clock = make_clock(transforms.path, transforms.timestamps())
        files = FrameFiles(self.root or path, path, transforms.frames)
        views = sorted(files.make_views(transforms.path, self.missing, clock), key=lambda view: view.name)
        new_names = dict(zip(files.raw_names, files.names, strict=True))
        train, test = (_read_list(transforms, key, new_names) for key in ("train_filenames", "test_filenames"))
        if train is None and test is None:
            test = {views[i].name for i in every_nth([view.name for view in views], holdout)}
        split_views = views if train is None else [view for view in views if view.name in train | (test or set())]
        if len(split_views) < len(views):
            logger.info("%s: skipped %d images that no split lists", transforms.path, len(views) - len(split_views))
        return files.make_scene(path, split_views, test or set(), transforms.read_points(clock))

    def list_parts(self, parts: Parts) -> None:
        list_frames(parts, self.root or parts.path, TRANSFORMS_FILE)


def _read_list(transforms: Transforms, key: str, new_names: Mapping[str, str]) -> set[str] | None:
    """Return the view names in the list `key` of a file, or None if there is no such list.  Raises DataError.

    new_names: maps names in the file to the names of the views.
    """
    entries = transforms.table.get(key)
    if entries is None:
        return None
    if not isinstance(entries, list) or not all(isinstance(entry, str) for entry in entries):
        raise DataError(f"{transforms.path}: {key} is not a list of file paths; export the file again")
    names = {view_name(entry) for entry in entries}
    unknown_names = sorted(names - new_names.keys())
    if unknown_names:
        raise DataError(
            f"{transforms.path}: {key} lists {quote(unknown_names[0])}, which no frame has; remove it from the list"
        )
    return {new_names[name] for name in names}


# Read the multi-scale Blender datasets of mip-NeRF: one metadata.json, and every photograph at several sizes.

METADATA_FILE = "metadata.json"
COLUMNS = ("file_path", "cam2world", "width", "height", "focal", "label")  # one value for each image


class MultiscaleReader(Reader):
    """Read a multi-scale Blender scene; an image with label j has 1 / 2^j of the full width and height."""

    name = "multi-scale Blender"
    expects = METADATA_FILE

    def matches(self, path: Path) -> bool:
        file = path / METADATA_FILE
        return file.is_file() and not describe_unsupported_cameras(file)

    def read(self, path: Path, holdout: int) -> Scene:
        splits = read_json(path / METADATA_FILE, limit=MAX_BYTES)
        train, test = (_read_frames(path / METADATA_FILE, splits, name) for name in ("train", "test"))
        files = FrameFiles(self.root or path, path, train + test)
        levels = {name: frame.number("label") or 0 for name, frame in zip(files.names, files.frames, strict=True)}
        views = [replace(view, downscale=2 ** levels[view.name]) for view in files.make_views(path, self.missing)]
        points = path / POINTS_FILE
        cloud = read_points_ply(points) if points.is_file() else None
        return files.make_scene(path, views, {*files.names[len(train) :]}, cloud, background="white")

    def list_parts(self, parts: Parts) -> None:
        super().list_parts(parts)
        points = parts.path / POINTS_FILE
        parts.points = parts.attempt(read_ply_table, points) if points.is_file() else None


def _read_frames(path: Path, splits: Any, name: str) -> list[JsonFrame]:
    table = splits.get(name) if isinstance(splits, dict) else None
    columns: list[Any] = [table.get(column) for column in COLUMNS] if isinstance(table, dict) else [None]
    if not all(isinstance(column, list) for column in columns) or len(set(map(len, columns))) > 1:
        raise DataError(f"{path}: '{name}' needs lists of equal length named {', '.join(COLUMNS)}; create it again")
    if len(columns[0]) > MAX_FRAMES:
        raise DataError(f"{path}: '{name}' has {len(columns[0])} images; expected at most {MAX_FRAMES}: split it")
    frames = []
    for i, (file, pose, width, height, focal, label) in enumerate(zip(*columns, strict=True)):
        values = {"file_path": file, "transform_matrix": pose, "w": width, "h": height, "fl_x": focal, "label": label}
        frame = JsonFrame(path.parent, f"{path}: {name}[{i}]", values)
        level = frame.number("label")
        if level is None or not 0 <= level <= 8 or level % 1:
            raise DataError(
                f"{frame.source}: label is {quote(label)}; expected the number of halvings, 0 to 8: create it again"
            )
        frames.append(frame)
    return frames
