"""Read COLMAP folders: choose the model, find its photographs, and make pinhole cameras."""

import logging
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote, shorten
from clsplat.core.quaternions import rotation_matrix
from clsplat.core.reading import read_file
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Lens, intern_lens
from clsplat.scene.camera import MODELS as LENS_MODELS
from clsplat.scene.images import find_existing, safe_join
from clsplat.scene.photographs import find_mask
from clsplat.scene.points import MAX_VALUE, PointTable
from clsplat.scene.reader import Parts, Reader
from clsplat.scene.reprojection import reprojection_residuals
from clsplat.scene.scene import PointCloud, Scene, Tracks, every_nth, make_scene
from clsplat.scene.times_file import add_times
from clsplat.scene.view import View

# Records of a COLMAP model, binary or text: camera models, cameras and images.

# Camera models in order of their ids, with the number of parameters (COLMAP 4, sensor/models.h).
PARAMETERS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}
MODELS = list(PARAMETERS)
REMEDY = "copy or export the model again"


class CameraRecord(NamedTuple):
    """A line of `cameras`; `where` is its place, for messages."""

    where: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """A line of `images`: quaternion (w, x, y, z) and translation, world to camera.

    `points` are the ids of the 3D points that its 2D points show, `places` where, [K, 2] px.
    """

    where: str
    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    points: NDArray[np.int64] = np.empty(0, np.int64)
    places: NDArray[np.float64] = np.empty((0, 2))

    @property
    def observed(self) -> int:
        """The number of its 2D points that show a 3D point."""
        return len(self.points)


def parameter_count(where: str, model: str) -> int:
    """Return the number of parameters of a camera model.  Raises DataError, starting with `where`, for others."""
    if model not in PARAMETERS:
        raise DataError(f"{where}: unknown camera model {quote(model)}; expected one of {', '.join(PARAMETERS)}")
    return PARAMETERS[model]


def decode(where: str, data: bytes) -> str:
    """Return bytes as text.  Raises DataError, starting with `where`, when they are not UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not UTF-8 text ({error}); {REMEDY}") from error


# Read the text files of a COLMAP model.

LARGEST_ID = 2**63 - 1


def cameras_text(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield ids and cameras.  Raises DataError, as all functions here, when the file is damaged."""
    for where, line in _lines(path):
        if line:
            layout = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
            words = line.split()
            number, model, width, height = _convert(where, words[:4], (int, str, int, int), layout)
            params = _convert(where, words[4:], [float] * parameter_count(where, model), f"the parameters of {model}")
            yield number, CameraRecord(where, model, width, height, tuple(params))


def images_text(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    layout = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    kinds = (int, *[float] * 7, int, str)
    image: ImageRecord | None = None  # the line of its points may follow
    for where, line in _lines(path):
        if image and _is_points2d(line):
            points, places = _points2d(line)
            yield image._replace(points=points, places=places)
            image = None
        elif line:
            if image:
                yield image
            _, *pose, camera, name = _convert(where, line.split(maxsplit=9), kinds, layout)
            image = ImageRecord(where, name, camera, tuple(pose[:4]), tuple(pose[4:]))
    if image:
        yield image


def _is_points2d(line: str) -> bool:
    """Return whether a line holds 2D points, (X, Y, POINT3D_ID) each, or none; some writers omit such lines."""
    words = line.split()
    return len(words) % 3 == 0 and (not words or words[-1].lstrip("-").isdecimal())


def _points2d(line: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The ids of the 3D points in a line of 2D points, and their places, [K, 2] px."""
    words = line.split()
    named = [i for i in range(2, len(words), 3) if words[i].isdecimal()]
    places = [(_number(words[i - 2]), _number(words[i - 1])) for i in named]
    return np.array([_id(words[i]) for i in named], np.int64), np.array(places, np.float64).reshape(-1, 2)


def _number(word: str) -> float:
    """A coordinate of a 2D point; NaN where it is none, as nothing but its error is known by it."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def points_text(path: Path) -> PointTable:
    """Return all points with their errors."""
    kinds = (_id, float, float, float, _byte, _byte, _byte, float)
    layout = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    rows = [_convert(where, line.split(maxsplit=8)[:8], kinds, layout) for where, line in _lines(path) if line]
    table = np.array([row[1:] for row in rows], np.float64).reshape(-1, 7)
    ids = np.array([row[0] for row in rows], np.int64).reshape(-1)
    return PointTable(path, table[:, :3], table[:, 3:6], table[:, 6], ids)


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of every line that is not a comment."""
    text = decode(str(path), read_file(path)).lstrip("\ufeff")
    for number, line in enumerate(map(str.strip, text.split("\n")), start=1):
        if not line.startswith("#"):
            yield f"{path}: line {number}", line


def _convert(where: str, words: list[str], kinds: Sequence[Callable[[str], Any]], layout: str) -> list[Any]:
    """Convert each word to its kind.  Raises DataError with the line."""
    if len(words) != len(kinds):
        raise DataError(f"{where}: expected {layout}, found {len(words)} of {len(kinds)} words; {REMEDY}")
    try:
        return [kind(word) for kind, word in zip(kinds, words, strict=True)]
    except ValueError as error:
        raise DataError(f"{where}: {shorten(str(error))}; expected {layout}: remove that entry or {REMEDY}") from error


def _id(word: str) -> int:
    """The id of a point; those that COLMAP does not give are one."""
    return min(max(int(word), -1), LARGEST_ID)


def _byte(word: str) -> int:
    if not 0 <= int(word) <= 255:
        raise ValueError(f"color {word} is not in 0..255")
    return int(word)


# Read the binary files of a COLMAP model; every number is checked against the end of the file.

POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class _Binary:
    """A binary file, read from front to back; each step first checks that the bytes exist."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_file(path), 0

    @property
    def where(self) -> str:
        return f"{self.path}: byte {self.at}"

    def skip(self, size: int, what: str) -> int:
        """Pass over `size` bytes and return where they start."""
        left = len(self.data) - self.at
        if size > left:
            raise DataError(
                f"{self.where}: expected {size} bytes of {what}, found {left}; truncated or damaged: {REMEDY}"
            )
        self.at += size
        return self.at - size

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout), what))

    def count(self, stride: int, what: str) -> int:
        """Take a number of records, of at least `stride` bytes each, and check that there is room for them."""
        (count,) = self.take("<Q", f"the number of {what}")
        self.at = self.skip(count * stride, f"{count} {what}")
        return int(count)

    def text(self, what: str) -> str:
        """Take UTF-8 text up to the next zero byte."""
        where, end = self.where, self.data.find(b"\0", self.at)
        start = self.skip((end if end >= 0 else len(self.data)) + 1 - self.at, what)
        return decode(where, self.data[start:end])

    def finish(self) -> None:
        if self.at < len(self.data):
            raise DataError(f"{self.where}: {len(self.data) - self.at} bytes follow the last record; damaged: {REMEDY}")


def cameras_binary(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield ids and cameras.  Raises DataError, as all functions here, when the file is damaged."""
    file = _Binary(path)
    for _ in range(file.count(24, "cameras")):
        where = file.where
        number, model, width, height = file.take("<IiQQ", "a camera")
        name = MODELS[model] if 0 <= model < len(MODELS) else str(model)
        params = file.take(f"<{parameter_count(where, name)}d", "camera parameters")
        yield number, CameraRecord(where, name, width, height, params)
    file.finish()


def images_binary(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    file = _Binary(path)
    for _ in range(file.count(73, "images")):
        where = file.where
        _, *pose, camera = file.take("<I7dI", "an image")
        name = file.text("an image name")
        count = file.count(POINT2D.itemsize, "2D points")
        start = file.skip(POINT2D.itemsize * count, "2D points")
        found = np.frombuffer(file.data, POINT2D, count, start)
        found = found[found["point"] >= 0]
        yield ImageRecord(where, name, camera, tuple(pose[:4]), tuple(pose[4:]), found["point"], found["xy"])
    file.finish()


def points_binary(path: Path) -> PointTable:
    """Return all points with their errors."""
    file = _Binary(path)
    starts = np.empty(file.count(POINT.itemsize, "points"), np.int64)
    for i in range(len(starts)):  # points differ in length by their tracks: a loop finds where they start
        starts[i] = file.skip(POINT.itemsize - 8, "a point")
        file.skip(8 * file.count(8, "track elements"), "track elements")
    file.finish()
    if len(starts) == 0:
        return PointTable(path, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    records = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, np.uint8), POINT.itemsize)
    table = records[starts].view(POINT)[:, 0]
    return PointTable(path, table["position"], table["rgb"], table["error"], table["id"].astype(np.int64))


# Read the three files of a COLMAP model, binary or text; damaged numbers are errors.


def find_file(folder: Path, stem: str) -> Path | None:
    """Return `stem`.bin or else `stem`.txt in a folder, or None."""
    files = (folder / f"{stem}.bin", folder / f"{stem}.txt")
    return next((file for file in files if file.is_file()), None)


def read_cameras(folder: Path) -> dict[int, CameraRecord]:
    """Return the cameras of a model by their ids.  Raises DataError, as all here, for a damaged file."""
    file = _require_file(folder, "cameras")
    cameras: dict[int, CameraRecord] = {}
    for number, camera in cameras_binary(file) if file.suffix == ".bin" else cameras_text(file):
        if number in cameras:
            raise DataError(f"{camera.where}: a second camera {number}; expected different ids: {REMEDY}")
        cameras[number] = camera
    return cameras


def read_images(folder: Path) -> list[ImageRecord]:
    """Return the registered images of a model, in the order of the file."""
    file = _require_file(folder, "images")
    return list(images_binary(file) if file.suffix == ".bin" else images_text(file))


def read_point_table(folder: Path) -> PointTable | None:
    """Return the points of a model with their errors, or None when it has no such file."""
    file = find_file(folder, "points3D")
    if file is None:
        return None
    return points_binary(file) if file.suffix == ".bin" else points_text(file)


def _require_file(folder: Path, stem: str) -> Path:
    file = find_file(folder, stem)
    if file is None:
        raise DataError(f"{folder}: no {stem}.bin or {stem}.txt; {REMEDY}")
    return file


logger = logging.getLogger("clsplat")


class ColmapReader(Reader):
    """A COLMAP scene: models in `sparse/N`, `sparse` or the folder itself, photographs in `images`.

    Of several models the reader takes the one with most images.  Every `holdout`-th view by name is for testing.
    Photographs of cameras with distortion are undistorted when they are read.  Masks lie in the folder
    `masks`: their names are those of the images with .png appended, or in place of the suffix.  With a file
    `images/times.json`, a number for each image by name, the scene moves.
    """

    name = "COLMAP"
    expects = "sparse/0/cameras.bin or .txt"

    def matches(self, path: Path) -> bool:
        return bool(find_models(path))

    def read(self, path: Path, holdout: int) -> Scene:
        model, images = _largest_model(path)
        cameras = read_cameras(model)
        folder = image_folder(path)
        views = sorted((view_of(image, cameras, folder) for image in images), key=lambda view: view.name)
        there = find_existing(path, [view.image_path for view in views], self.missing)
        skipped = tuple(view.name for view, found in zip(views, there, strict=True) if not found)
        views = add_times([view for view, found in zip(views, there, strict=True) if found], folder)
        table = read_point_table(model)
        points, tracks = (table.cloud(), tracks_of(images, table, views)) if table else (None, None)
        scene = make_scene(path, views, every_nth([view.name for view in views], holdout), points)
        return replace(scene, tracks=tracks and tracks.shifted(scene.origin), skipped=skipped)

    def list_parts(self, parts: Parts) -> None:
        found = [(folder, parts.attempt(read_images, folder) or []) for folder in find_models(parts.path)]
        found.sort(key=lambda model: -len(model[1]))  # `read` takes the first of the largest, and sorting is stable
        parts.submodels = {str(folder.relative_to(parts.path)): len(images) for folder, images in found}
        model, images = found[0]
        cameras = parts.attempt(read_cameras, model)
        parts.points = parts.attempt(read_point_table, model)
        parts.image_folder = folder = image_folder(parts.path)
        files = [parts.attempt(safe_join, folder, image.name, image.where) for image in images]
        parts.expected = [file for file in files if file]
        for image in images if cameras else []:
            if view := parts.attempt(view_of, image, cameras, folder):
                parts.views.append(view)
                parts.models[view.name] = cameras[image.camera].model if cameras else ""
                parts.observed[view.name] = image.observed


def camera_views(path: Path) -> tuple[list[View], PointCloud | None]:
    """Return a view for each image of the largest model, whether or not its file exists, and the points."""
    model, images = _largest_model(path)
    cameras, folder, table = read_cameras(model), image_folder(path), read_point_table(model)
    return [view_of(image, cameras, folder) for image in images], table.cloud() if table else None


def tracks_of(images: Sequence[ImageRecord], table: PointTable, views: Sequence[View] = ()) -> Tracks | None:
    """Return which points each image shows, or None where no image names one; of `views` how far from their places."""
    kept = table.kept()
    positions, ids = table.positions[kept], table.ids[kept]
    order = np.argsort(ids, kind="stable")
    seen, missed, by_name = {}, {}, {view.name: view for view in views}
    for image in images:
        named, first = np.unique(image.points, return_index=True)
        place = np.minimum(np.searchsorted(ids[order], named), max(len(ids) - 1, 0))
        known = ids[order][place] == named if len(ids) else np.zeros(len(named), bool)
        rows = seen[image.name] = order[place[known]] if len(ids) else np.empty(0, np.int64)
        if len(rows) and len(image.places) and image.name in by_name:
            missed[image.name] = reprojection_residuals(
                by_name[image.name], positions[rows], image.places[first[known]]
            )
    return Tracks(positions, seen, missed) if any(map(len, seen.values())) else None


def find_models(path: Path) -> list[Path]:
    """Return the folders at or below `path` that hold a COLMAP model, by name."""
    sparse = path / "sparse"
    folders = [path, sparse, *(sorted(sparse.iterdir()) if sparse.is_dir() else [])]
    return [folder for folder in folders if find_file(folder, "cameras") and find_file(folder, "images")]


def _largest_model(path: Path) -> tuple[Path, list[ImageRecord]]:
    models = [(folder, read_images(folder)) for folder in find_models(path)]
    if not models:
        raise DataError(f"{path}: no COLMAP model; expected cameras and images (.bin or .txt) in sparse/0, sparse or .")
    best = max(models, key=lambda model: len(model[1]))
    if others := ", ".join(f"{folder} ({len(images)})" for folder, images in models if folder != best[0]):
        logger.info("%s: used with %d images, the most of all models; not used: %s", best[0], len(best[1]), others)
    return best


def image_folder(path: Path) -> Path:
    """Return `images` beside `sparse` when `path` is `sparse` or one of its models, else `images` in `path`."""
    return next((folder.parent for folder in (path, path.parent) if folder.name == "sparse"), path) / "images"


def view_of(image: ImageRecord, cameras: dict[int, CameraRecord], folder: Path) -> View:
    """Check one image and its camera.  Raises DataError."""
    image_path = safe_join(folder, image.name, image.where)
    if image.camera not in cameras:
        raise DataError(
            f"{image.where}: image {quote(image.name)} names camera {image.camera}; expected one of the cameras file, "
            f"{sorted(cameras)[:8]}: {REMEDY}"
        )
    try:
        pose = pose_matrix(image.quaternion, image.translation)
    except ValueError as error:
        raise DataError(
            f"{image.where}: the pose of {quote(image.name)} is {error}: remove that image or {REMEDY}"
        ) from error
    lens = intern_lens(_lens(image.camera, cameras[image.camera]))
    camera, distortion = (lens.pinhole, lens) if lens.has_distortion else (lens.camera, None)
    return View(image.name, camera, pose, image_path, find_mask(folder.with_name("masks"), image.name), lens=distortion)


def _lens(number: int, camera: CameraRecord) -> Lens:
    """Check a camera.  Raises DataError for models that are not supported, and for invalid numbers."""
    if camera.model not in LENS_MODELS:
        raise DataError(
            f"{camera.where}: camera {number} is {camera.model}; expected one of {', '.join(LENS_MODELS)}: "
            "undistort the images first with `colmap image_undistorter`"
        )
    sizes = camera.width, camera.height
    valid = (
        min(sizes) > 0 and max(sizes) <= MAX_SIDE and min(camera.params[: LENS_MODELS[camera.model][0]]) >= MIN_FOCAL
    )
    if not valid or not all(abs(value) < MAX_VALUE for value in camera.params):
        raise DataError(
            f"{camera.where}: camera {number} is {camera.width}x{camera.height} with parameters "
            f"{quote(camera.params)}; expected a positive size of at most {MAX_SIDE}, focal lengths from "
            f"{MIN_FOCAL:g} on and finite numbers: {REMEDY}"
        )
    return Lens(camera.width, camera.height, camera.model, camera.params)


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose [3, 4] of a quaternion of any length but zero and a translation in scene units.

    Raises ValueError when numbers are missing or not finite, or the quaternion is zero.
    """
    length = math.hypot(*quaternion)
    sizes = len(quaternion), len(translation)
    if sizes != (4, 3) or not 0 < length < math.inf or not all(abs(part) < MAX_VALUE for part in translation):
        raise ValueError(
            f"quaternion {quote(tuple(quaternion))}, translation {quote(tuple(translation))}; "
            "expected finite numbers and a rotation"
        )
    return np.column_stack([rotation_matrix(*(part / length for part in quaternion)), translation])
