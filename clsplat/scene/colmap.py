"""Read COLMAP folders: choose a model, find its photographs, and create pinhole cameras."""

import logging
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote, shorten
from clsplat.core.quaternions import rotation_matrix
from clsplat.core.reading import read_file, require_content
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Lens, intern_lens, panorama_lens
from clsplat.scene.camera import MODELS as LENS_MODELS
from clsplat.scene.lookup import FileLookup
from clsplat.scene.photographs import find_masks
from clsplat.scene.points import MAX_VALUE, PointTable
from clsplat.scene.reader import Parts, Reader
from clsplat.scene.reprojection import reprojection_residuals
from clsplat.scene.scene import PointCloud, Scene, Tracks, every_nth, make_scene
from clsplat.scene.times_file import add_times
from clsplat.scene.view import NO_FILE, View, fit_to_photograph

# Define the records of a COLMAP model: camera models, cameras and images.

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
    """A camera; `source` is its position in the file, for messages."""

    source: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """An image: its name, camera id, and world-to-camera quaternion (w, x, y, z) and translation.

    `points` are the ids of the 3D points that the image shows, [K], and `pixels` their positions, [K, 2] px.
    """

    source: str
    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    points: NDArray[np.int64] = np.empty(0, np.int64)
    pixels: NDArray[np.float64] = np.empty((0, 2))


def parameter_count(source: str, model: str) -> int:
    """Return the number of parameters of a camera model.  Raises DataError, with `source`, for an unknown model."""
    if model not in PARAMETERS:
        raise DataError(f"{source}: unknown camera model {quote(model)}; expected one of {', '.join(PARAMETERS)}")
    return PARAMETERS[model]


def decode(source: str, data: bytes) -> str:
    """Decode UTF-8.  Raises DataError, prefixed with `source`, for other bytes."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{source}: not UTF-8 text ({error}); {REMEDY}") from error


# Read the text files of a COLMAP model.

LARGEST_ID = 2**63 - 1


def cameras_text(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield ids and cameras.  Raises DataError, like all functions here, if the file is damaged."""
    for source, line in _lines(path):
        if line:
            layout = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
            words = line.split()
            number, model, width, height = _convert(source, words[:4], (int, str, int, int), layout)
            params = _convert(source, words[4:], [float] * parameter_count(source, model), f"the parameters of {model}")
            yield number, CameraRecord(source, model, width, height, tuple(params))


def images_text(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    layout = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    kinds = (int, *[float] * 7, int, str)
    image: ImageRecord | None = None  # its points may follow on the next line
    for source, line in _lines(path):
        if image and _is_points2d(line):
            points, pixels = _points2d(line)
            yield image._replace(points=points, pixels=pixels)
            image = None
        elif line:
            if image:
                yield image
            _, *pose, camera, name = _convert(source, line.split(maxsplit=9), kinds, layout)
            image = ImageRecord(source, name, camera, tuple(pose[:4]), tuple(pose[4:]))
    if image:
        yield image


def _is_points2d(line: str) -> bool:
    """Return whether a line is empty or lists 2D points, (X, Y, POINT3D_ID); some writers omit these lines."""
    words = line.split()
    return len(words) % 3 == 0 and (not words or words[-1].lstrip("-").isdecimal())


def _points2d(line: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the ids of the 3D points in a line of 2D points, [K], and their positions, [K, 2] px."""
    words = line.split()
    indices = [i for i in range(2, len(words), 3) if words[i].isdecimal()]
    pixels = [(_number(words[i - 2]), _number(words[i - 1])) for i in indices]
    return np.array([_id(words[i]) for i in indices], np.int64), np.array(pixels, np.float64).reshape(-1, 2)


def _number(word: str) -> float:
    """Return a coordinate of a 2D point; NaN if it is not a number, since only reprojection errors need it."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def points_text(path: Path) -> PointTable:
    """Return all points with their reprojection errors."""
    kinds = (_id, float, float, float, _byte, _byte, _byte, float)
    layout = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    rows = [_convert(source, line.split(maxsplit=8)[:8], kinds, layout) for source, line in _lines(path) if line]
    table = np.array([row[1:] for row in rows], np.float64).reshape(-1, 7)
    ids = np.array([row[0] for row in rows], np.int64).reshape(-1)
    return PointTable(path, table[:, :3], table[:, 3:6], table[:, 6], ids)


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the position and the text of every line that is not a comment."""
    text = decode(str(path), read_file(path)).lstrip("\ufeff")
    require_content(path, text.encode() or b"#")  # a file without points may be empty
    for number, line in enumerate(map(str.strip, text.split("\n")), start=1):
        if not line.startswith("#"):
            yield f"{path}: line {number}", line


def _convert(source: str, words: list[str], kinds: Sequence[Callable[[str], Any]], layout: str) -> list[Any]:
    """Convert each word to its kind.  Raises DataError with the line."""
    if len(words) != len(kinds):
        raise DataError(f"{source}: expected {layout}, found {len(words)} of {len(kinds)} words; {REMEDY}")
    try:
        return [kind(word) for kind, word in zip(kinds, words, strict=True)]
    except ValueError as error:
        raise DataError(f"{source}: {shorten(str(error))}; expected {layout}: remove that entry or {REMEDY}") from error


def _id(word: str) -> int:
    """Return the id of a point, clamped to the ids that COLMAP uses; -1: none."""
    return min(max(int(word), -1), LARGEST_ID)


def _byte(word: str) -> int:
    if not 0 <= int(word) <= 255:
        raise ValueError(f"color {word} is not in 0..255")
    return int(word)


# Read the binary files of a COLMAP model; every number is checked against the end of the file.

POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class _Binary:
    """A reader of binary files that checks that bytes exist before it reads them."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.offset = path, read_file(path), 0
        require_content(path, self.data or b"#")  # `skip` says what an empty file lacks

    @property
    def source(self) -> str:
        """The position in the file, for messages."""
        return f"{self.path}: byte {self.offset}"

    def skip(self, size: int, label: str) -> int:
        """Skip `size` bytes and return the offset of the first."""
        available = len(self.data) - self.offset
        if size > available:
            raise DataError(
                f"{self.source}: expected {size} bytes of {label}, found {available}; truncated or damaged: {REMEDY}"
            )
        self.offset += size
        return self.offset - size

    def read(self, layout: str, label: str) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout), label))

    def count(self, stride: int, label: str) -> int:
        """Read the number of records, and check that this many records of at least `stride` bytes can follow."""
        (count,) = self.read("<Q", f"the number of {label}")
        self.offset = self.skip(count * stride, f"{count} {label}")
        return int(count)

    def text(self, label: str) -> str:
        """Read UTF-8 text up to the next zero byte."""
        source, end = self.source, self.data.find(b"\0", self.offset)
        start = self.skip((end if end >= 0 else len(self.data)) + 1 - self.offset, label)
        return decode(source, self.data[start:end])

    def finish(self) -> None:
        if self.offset < len(self.data):
            raise DataError(
                f"{self.source}: {len(self.data) - self.offset} bytes follow the last record; damaged: {REMEDY}"
            )


def cameras_binary(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield ids and cameras.  Raises DataError, like all functions here, if the file is damaged."""
    file = _Binary(path)
    for _ in range(file.count(24, "cameras")):
        source = file.source
        number, model, width, height = file.read("<IiQQ", "a camera")
        name = MODELS[model] if 0 <= model < len(MODELS) else str(model)
        params = file.read(f"<{parameter_count(source, name)}d", "camera parameters")
        yield number, CameraRecord(source, name, width, height, params)
    file.finish()


def images_binary(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    file = _Binary(path)
    for _ in range(file.count(73, "images")):
        source = file.source
        _, *pose, camera = file.read("<I7dI", "an image")
        name = file.text("an image name")
        count = file.count(POINT2D.itemsize, "2D points")
        start = file.skip(POINT2D.itemsize * count, "2D points")
        points = np.frombuffer(file.data, POINT2D, count, start)
        points = points[points["point"] >= 0]
        yield ImageRecord(source, name, camera, tuple(pose[:4]), tuple(pose[4:]), points["point"], points["xy"])
    file.finish()


def points_binary(path: Path) -> PointTable:
    """Return all points with their reprojection errors."""
    file = _Binary(path)
    starts = np.empty(file.count(POINT.itemsize, "points"), np.int64)
    for i in range(len(starts)):  # records have different lengths because of their tracks
        starts[i] = file.skip(POINT.itemsize - 8, "a point")
        file.skip(8 * file.count(8, "track elements"), "track elements")
    file.finish()
    if len(starts) == 0:
        return PointTable(path, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    records = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, np.uint8), POINT.itemsize)
    table = records[starts].view(POINT)[:, 0]
    return PointTable(path, table["position"], table["rgb"], table["error"], table["id"].astype(np.int64))


# Read the three files of a COLMAP model, binary or text.


def find_file(folder: Path, stem: str) -> Path | None:
    """Return `stem`.bin in a folder, otherwise `stem`.txt, or None."""
    files = (folder / f"{stem}.bin", folder / f"{stem}.txt")
    return next((file for file in files if file.is_file()), None)


def read_cameras(folder: Path) -> dict[int, CameraRecord]:
    """Return the cameras of a model by id.  Raises DataError, like all functions here, for a damaged file."""
    file = _require_file(folder, "cameras")
    cameras: dict[int, CameraRecord] = {}
    for number, camera in cameras_binary(file) if file.suffix == ".bin" else cameras_text(file):
        if number in cameras:
            raise DataError(f"{camera.source}: a second camera {number}; expected different ids: {REMEDY}")
        cameras[number] = camera
    return cameras


def read_images(folder: Path) -> list[ImageRecord]:
    """Return the registered images of a model, in the order of the file."""
    file = _require_file(folder, "images")
    return list(images_binary(file) if file.suffix == ".bin" else images_text(file))


def read_point_table(folder: Path) -> PointTable | None:
    """Return the points of a model with their reprojection errors, or None if the model has no such file."""
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

    If there are several models, the one with the most images is used.  Every `holdout`-th view by name is a test view.
    Photographs of cameras with distortion are undistorted when they are read.  The folder `masks` may contain masks,
    named like the images, with .png appended or as the suffix.  With a file `images/times.json` that gives each image a
    time, the scene is dynamic.
    """

    name = "COLMAP"
    expects = "sparse/0/cameras.bin or .txt"

    def matches(self, path: Path) -> bool:
        return bool(find_models(path))

    def read(self, path: Path, holdout: int) -> Scene:
        model, images = _largest_model(path)
        cameras = read_cameras(model)
        images, files, masks = self._files(path, images)
        views = [make_view(*row) for row in zip(images, repeat(cameras), files.paths, masks, strict=False)]
        views = sorted((views[i] for i in files.existing_indices(path, self.missing)), key=lambda view: view.name)
        views, table = add_times(views, files.folder), read_point_table(model)
        original = [view for view in views if view.image_path not in files.downscaled_files]
        points, tracks = (table.cloud(), make_tracks(images, table, original)) if table else (None, None)
        views = [fit_to_photograph(view) if view.image_path in files.downscaled_files else view for view in views]
        scene = make_scene(path, views, every_nth([view.name for view in views], holdout), points)
        tracks = tracks and tracks.shifted(scene.origin).split_by_face(scene.views)
        return replace(scene, tracks=tracks, skipped=files.skipped)

    def list_parts(self, parts: Parts) -> None:
        models = [(folder, parts.attempt(read_images, folder) or []) for folder in find_models(parts.path)]
        models.sort(key=lambda model: -len(model[1]))  # stable: the first of the largest is used, as in `read`
        parts.submodels = {str(folder.relative_to(parts.path)): len(images) for folder, images in models}
        model, images = models[0]
        cameras = parts.attempt(read_cameras, model)
        parts.points = parts.attempt(read_point_table, model)
        images, files, masks = self._files(parts.path, images)
        parts.image_folder = files.folder
        parts.expect(files)
        for image, file, mask in zip(images, files.paths, masks, strict=True) if cameras else []:
            if view := parts.attempt(make_view, image, cameras, file, mask):
                parts.views.append(fit_to_photograph(view) if file in files.downscaled_files else view)
                parts.models[view.name] = cameras[image.camera].model if cameras else ""
                parts.observed[view.name] = len(image.points)

    def _files(self, path: Path, images: list[ImageRecord]) -> tuple[list[ImageRecord], FileLookup, list[Path | None]]:
        """Return images with the names of their files, the files, and masks."""
        folder = image_folder(path, self.root)
        root = self.root if self.root and folder.is_relative_to(self.root) else folder.parent
        files = FileLookup(root, folder, [image.name for image in images])
        images = [image._replace(name=name) for image, name in zip(images, files.names, strict=True)]
        return images, files, find_masks(folder.with_name("masks"), files.names)


def camera_views(path: Path) -> tuple[list[View], PointCloud | None]:
    """Return a view without a photograph for each image of the largest model, and the points."""
    model, images = _largest_model(path)
    cameras, table = read_cameras(model), read_point_table(model)
    return [make_view(image, cameras) for image in images], table.cloud() if table else None


def make_tracks(images: Sequence[ImageRecord], table: PointTable, views: Sequence[View] = ()) -> Tracks | None:
    """Return which points each image shows, with reprojection residuals for `views`; None if no image lists points."""
    finite = table.is_finite()
    positions, ids = table.positions[finite], table.ids[finite]
    order = np.argsort(ids, kind="stable")
    seen, residuals, by_name = {}, {}, {view.name: view for view in views}
    for image in images:
        ids2, first = np.unique(image.points, return_index=True)
        nearest = np.minimum(np.searchsorted(ids[order], ids2), max(len(ids) - 1, 0))
        is_match = ids[order][nearest] == ids2 if len(ids) else np.zeros(len(ids2), bool)
        rows = seen[image.name] = order[nearest[is_match]] if len(ids) else np.empty(0, np.int64)
        view = by_name.get(image.name)
        if len(rows) and len(image.pixels) and view and not (view.lens and view.lens.is_wide):
            residuals[image.name] = reprojection_residuals(view, positions[rows], image.pixels[first[is_match]])
    return Tracks(positions, seen, residuals) if any(map(len, seen.values())) else None


def find_models(path: Path) -> list[Path]:
    """Return `path` and folders below it that contain a COLMAP model, sorted by name."""
    sparse = path / "sparse"
    folders = [path, sparse, *(sorted(sparse.iterdir()) if sparse.is_dir() else [])]
    files = {folder: sum(find_file(folder, stem) is not None for stem in ("cameras", "images")) for folder in folders}
    complete = [folder for folder, count in files.items() if count == 2]
    return complete or [folder for folder, count in files.items() if count == 1 and find_file(folder, "points3D")]


def _largest_model(path: Path) -> tuple[Path, list[ImageRecord]]:
    models = [(folder, read_images(folder)) for folder in find_models(path)]
    if not models:
        raise DataError(f"{path}: no COLMAP model; expected cameras and images (.bin or .txt) in sparse/0, sparse or .")
    best = max(models, key=lambda model: len(model[1]))
    if others := ", ".join(f"{folder} ({len(images)})" for folder, images in models if folder != best[0]):
        logger.info("%s: the largest model, with %d images, is used; not used: %s", best[0], len(best[1]), others)
    return best


def image_folder(path: Path, root: Path | None = None) -> Path:
    """Return `images` next to `sparse` if `path` is `sparse` or one of its models, otherwise `images` in `path`.

    Without that folder, return the first `images` above it that is not above `root`.
    """
    folder = next((folder.parent for folder in (path, path.parent) if folder.name == "sparse"), path)
    folders = [folder, *(parent for parent in folder.parents if root and parent.is_relative_to(root))]
    return next((parent / "images" for parent in folders if (parent / "images").is_dir()), folders[-1] / "images")


def make_view(
    image: ImageRecord, cameras: dict[int, CameraRecord], file: Path = NO_FILE, mask: Path | None = None
) -> View:
    """Return the view of an image.  Raises DataError if the image or its camera is invalid."""
    if image.camera not in cameras:
        raise DataError(
            f"{image.source}: image {quote(image.name)} has camera {image.camera}; expected one of the cameras file, "
            f"{sorted(cameras)[:8]}: {REMEDY}"
        )
    try:
        pose = pose_matrix(image.quaternion, image.translation)
    except ValueError as error:
        raise DataError(
            f"{image.source}: the pose of {quote(image.name)} is {error}: remove that image or {REMEDY}"
        ) from error
    lens = intern_lens(_lens(image.camera, cameras[image.camera]))
    camera, distortion = (lens.pinhole, lens) if lens.has_distortion else (lens.camera, None)
    return View(image.name, camera, pose, file, mask, lens=distortion)


def _lens(number: int, camera: CameraRecord) -> Lens:
    """Return the lens of a camera.  Raises DataError for invalid numbers."""
    sizes, focals = (camera.width, camera.height), camera.params[: LENS_MODELS[camera.model][0]]
    is_valid = min(sizes) > 0 and max(sizes) <= MAX_SIDE and min(focals) >= MIN_FOCAL
    if not is_valid or not all(abs(value) < MAX_VALUE for value in camera.params):
        raise DataError(
            f"{camera.source}: camera {number} is {camera.width}x{camera.height} with parameters "
            f"{quote(camera.params)}; expected a positive size of at most {MAX_SIDE}, focal lengths of "
            f"at least {MIN_FOCAL:g}, and finite numbers: {REMEDY}"
        )
    if camera.model != "EQUIRECTANGULAR":
        return Lens(camera.width, camera.height, camera.model, camera.params)
    if camera.params != sizes:
        raise DataError(
            f"{camera.source}: camera {number} is EQUIRECTANGULAR with parameters {quote(camera.params)}; expected the "
            f"size of its images, {camera.width}, {camera.height}: {REMEDY}"
        )
    return panorama_lens(*sizes)


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose [3, 4] of a quaternion, of any nonzero length, and a translation in scene units.

    Raises ValueError if numbers are missing or not finite, or the quaternion is zero.
    """
    length = math.hypot(*quaternion)
    sizes = len(quaternion), len(translation)
    if sizes != (4, 3) or not 0 < length < math.inf or not all(abs(part) < MAX_VALUE for part in translation):
        raise ValueError(
            f"quaternion {quote(tuple(quaternion))}, translation {quote(tuple(translation))}; "
            "expected finite numbers and a rotation"
        )
    return np.column_stack([rotation_matrix(*(part / length for part in quaternion)), translation])
