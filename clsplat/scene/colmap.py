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

# Camera models in order of their IDs, with the number of parameters (COLMAP 4, sensor/models.h).
PARAMETERS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}
MODELS = list(PARAMETERS)
REMEDY = "copy or export the model again"


class CameraRecord(NamedTuple):
    """A camera with its size in pixels and its parameters; `source` is its position in the file, for messages."""

    source: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """An image with its name, camera ID, and pose: world-to-camera quaternion (w, x, y, z) and translation.

    `points` are the IDs of the 3D points that the image shows, [K], and `pixels` are their positions, [K, 2] px.
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
    """Decode UTF-8 text.  Raises DataError, with `source`, if the bytes are not UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{source}: not UTF-8 text ({error}); {REMEDY}") from error


# Read the text files of a COLMAP model.

MAX_ID = 2**63 - 1


def read_cameras_text(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield the ID and the record of each camera.  Raises DataError, like all functions here, for a damaged file."""
    for source, line in _read_lines(path):
        if line:
            layout = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
            fields = line.split()
            camera_id, model, width, height = _convert(source, fields[:4], (int, str, int, int), layout)
            types = [float] * parameter_count(source, model)
            params = _convert(source, fields[4:], types, f"the parameters of {model}")
            yield camera_id, CameraRecord(source, model, width, height, tuple(params))


def read_images_text(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    layout = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    types = (int, *[float] * 7, int, str)
    image: ImageRecord | None = None  # its points may follow on the next line
    for source, line in _read_lines(path):
        if image and _is_points2d(line):
            points, pixels = _parse_points2d(line)
            yield image._replace(points=points, pixels=pixels)
            image = None
        elif line:
            if image:
                yield image
            _, *pose, camera, name = _convert(source, line.split(maxsplit=9), types, layout)
            image = ImageRecord(source, name, camera, tuple(pose[:4]), tuple(pose[4:]))
    if image:
        yield image


def _is_points2d(line: str) -> bool:
    """Return whether a line is empty or lists 2D points, (X, Y, POINT3D_ID); some writers omit these lines."""
    fields = line.split()
    return len(fields) % 3 == 0 and (not fields or fields[-1].lstrip("-").isdecimal())


def _parse_points2d(line: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Parse a line of 2D points: return the IDs of their 3D points, [K], and their positions, [K, 2] px."""
    fields = line.split()
    indices = [i for i in range(2, len(fields), 3) if fields[i].isdecimal()]
    pixels = [(_parse_coordinate(fields[i - 2]), _parse_coordinate(fields[i - 1])) for i in indices]
    return np.array([_parse_id(fields[i]) for i in indices], np.int64), np.array(pixels, np.float64).reshape(-1, 2)


def _parse_coordinate(text: str) -> float:
    """Parse a coordinate of a 2D point; NaN if it is not a number, since only reprojection errors need it."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_points_text(path: Path) -> PointTable:
    """Return all points with their reprojection errors."""
    types = (_parse_id, float, float, float, _parse_byte, _parse_byte, _parse_byte, float)
    layout = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    rows = [_convert(source, line.split(maxsplit=8)[:8], types, layout) for source, line in _read_lines(path) if line]
    table = np.array([row[1:] for row in rows], np.float64).reshape(-1, 7)
    ids = np.array([row[0] for row in rows], np.int64).reshape(-1)
    return PointTable(path, table[:, :3], table[:, 3:6], table[:, 6], ids)


def _read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the position, for messages, and the text of each line that is not a comment."""
    text = decode(str(path), read_file(path)).lstrip("\ufeff")
    require_content(path, text.encode() or b"#")  # a file without points may be empty
    for number, line in enumerate(map(str.strip, text.split("\n")), start=1):
        if not line.startswith("#"):
            yield f"{path}: line {number}", line


def _convert(source: str, fields: list[str], types: Sequence[Callable[[str], Any]], layout: str) -> list[Any]:
    """Convert the fields of a line to their types.  Raises DataError, with `source` and `layout`, if that fails."""
    if len(fields) != len(types):
        raise DataError(f"{source}: expected {layout}, found {len(fields)} of {len(types)} values; {REMEDY}")
    try:
        return [convert(field) for convert, field in zip(types, fields, strict=True)]
    except ValueError as error:
        raise DataError(f"{source}: {shorten(str(error))}; expected {layout}: remove that entry or {REMEDY}") from error


def _parse_id(text: str) -> int:
    """Parse the ID of a point, clamped to the range that COLMAP uses.  -1 means no point."""
    return min(max(int(text), -1), MAX_ID)


def _parse_byte(text: str) -> int:
    if not 0 <= int(text) <= 255:
        raise ValueError(f"color {text} is not in 0..255")
    return int(text)


# Read the binary files of a COLMAP model; every number is checked against the end of the file.

POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class _BinaryFile:
    """A reader of binary values.  Raises DataError if the file ends too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.offset = path, read_file(path), 0
        require_content(path, self.data or b"#")  # `skip` reports what an empty file lacks

    @property
    def source(self) -> str:
        """The position in the file, for messages."""
        return f"{self.path}: byte {self.offset}"

    def skip(self, size: int, label: str) -> int:
        """Skip `size` bytes and return the offset of the first byte.  label: the name of these bytes in messages."""
        available = len(self.data) - self.offset
        if size > available:
            raise DataError(
                f"{self.source}: expected {size} bytes of {label}, found {available}; truncated or damaged: {REMEDY}"
            )
        self.offset += size
        return self.offset - size

    def read(self, layout: str, label: str) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout), label))

    def read_count(self, stride: int, label: str) -> int:
        """Read the number of records, and check that the file can hold that many records of at least `stride` bytes."""
        (count,) = self.read("<Q", f"the number of {label}")
        self.offset = self.skip(count * stride, f"{count} {label}")
        return int(count)

    def read_string(self, label: str) -> str:
        """Read UTF-8 text up to the next zero byte."""
        source, end = self.source, self.data.find(b"\0", self.offset)
        start = self.skip((end if end >= 0 else len(self.data)) + 1 - self.offset, label)
        return decode(source, self.data[start:end])

    def require_end(self) -> None:
        if self.offset < len(self.data):
            raise DataError(
                f"{self.source}: the file is damaged: {len(self.data) - self.offset} bytes follow the last record; "
                f"{REMEDY}"
            )


def read_cameras_binary(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    """Yield the ID and the record of each camera.  Raises DataError, like all functions here, for a damaged file."""
    file = _BinaryFile(path)
    for _ in range(file.read_count(24, "cameras")):
        source = file.source
        camera_id, model, width, height = file.read("<IiQQ", "a camera")
        name = MODELS[model] if 0 <= model < len(MODELS) else str(model)
        params = file.read(f"<{parameter_count(source, name)}d", "camera parameters")
        yield camera_id, CameraRecord(source, name, width, height, params)
    file.require_end()


def read_images_binary(path: Path) -> Iterator[ImageRecord]:
    """Yield the registered images, in the order of the file."""
    file = _BinaryFile(path)
    for _ in range(file.read_count(73, "images")):
        source = file.source
        _, *pose, camera = file.read("<I7dI", "an image")
        name = file.read_string("an image name")
        count = file.read_count(POINT2D.itemsize, "2D points")
        start = file.skip(POINT2D.itemsize * count, "2D points")
        points = np.frombuffer(file.data, POINT2D, count, start)
        points = points[points["point"] >= 0]
        yield ImageRecord(source, name, camera, tuple(pose[:4]), tuple(pose[4:]), points["point"], points["xy"])
    file.require_end()


def read_points_binary(path: Path) -> PointTable:
    """Return all points with their reprojection errors."""
    file = _BinaryFile(path)
    starts = np.empty(file.read_count(POINT.itemsize, "points"), np.int64)
    for i in range(len(starts)):  # records have different lengths because of their tracks
        starts[i] = file.skip(POINT.itemsize - 8, "a point")
        file.skip(8 * file.read_count(8, "track elements"), "track elements")
    file.require_end()
    if len(starts) == 0:
        return PointTable(path, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    records = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, np.uint8), POINT.itemsize)
    table = records[starts].view(POINT)[:, 0]
    return PointTable(path, table["position"], table["rgb"], table["error"], table["id"].astype(np.int64))


# Read the three files of a COLMAP model, binary or text.


def find_file(folder: Path, stem: str) -> Path | None:
    """Return the path of `stem`.bin in a folder, otherwise of `stem`.txt; None if neither exists."""
    files = (folder / f"{stem}.bin", folder / f"{stem}.txt")
    return next((file for file in files if file.is_file()), None)


def read_cameras(folder: Path) -> dict[int, CameraRecord]:
    """Return the cameras of a model by ID.  Raises DataError, like all functions here, for a damaged file."""
    file = _require_file(folder, "cameras")
    cameras: dict[int, CameraRecord] = {}
    for camera_id, camera in read_cameras_binary(file) if file.suffix == ".bin" else read_cameras_text(file):
        if camera_id in cameras:
            raise DataError(f"{camera.source}: camera ID {camera_id} is not unique; {REMEDY}")
        cameras[camera_id] = camera
    return cameras


def read_images(folder: Path) -> list[ImageRecord]:
    """Return the registered images of a model, in the order of the file."""
    file = _require_file(folder, "images")
    return list(read_images_binary(file) if file.suffix == ".bin" else read_images_text(file))


def read_point_table(folder: Path) -> PointTable | None:
    """Return the points of a model with their reprojection errors, or None if the model has no file of points."""
    file = find_file(folder, "points3D")
    if file is None:
        return None
    return read_points_binary(file) if file.suffix == ".bin" else read_points_text(file)


def _require_file(folder: Path, stem: str) -> Path:
    file = find_file(folder, stem)
    if file is None:
        raise DataError(f"{folder}: no {stem}.bin or {stem}.txt; {REMEDY}")
    return file


logger = logging.getLogger("clsplat")


class ColmapReader(Reader):
    """A COLMAP scene: models in `sparse/N`, `sparse` or the folder itself, photographs in `images`.

    If there are several models, the one with the most images is used.  Every `holdout`-th view in order of name is a
    test view.

    Photographs of cameras with distortion are undistorted when they are read.  The folder `masks` may contain masks,
    named like the images, with .png added or as the new suffix.  With a file `images/times.json` that lists the time of
    each image, the scene is dynamic.
    """

    name = "COLMAP"
    expects = "sparse/0/cameras.bin or .txt"

    def matches(self, path: Path) -> bool:
        return bool(find_models(path))

    def read(self, path: Path, holdout: int) -> Scene:
        model, images = _read_largest_model(path)
        cameras = read_cameras(model)
        images, files, masks = self._locate(path, images)
        views = [make_view(*args) for args in zip(images, repeat(cameras), files.paths, masks, strict=False)]
        views = sorted((views[i] for i in files.existing_indices(path, self.missing)), key=lambda view: view.name)
        views, table = add_times(views, files.folder), read_point_table(model)
        full_size = [view for view in views if view.image_path not in files.downscaled_files]
        points, tracks = (table.to_point_cloud(), make_tracks(images, table, full_size)) if table else (None, None)
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
        images, files, masks = self._locate(parts.path, images)
        parts.image_folder = files.folder
        parts.expect(files)
        for image, file, mask in zip(images, files.paths, masks, strict=True) if cameras else []:
            if view := parts.attempt(make_view, image, cameras, file, mask):
                parts.views.append(fit_to_photograph(view) if file in files.downscaled_files else view)
                parts.models[view.name] = cameras[image.camera].model if cameras else ""
                parts.observed[view.name] = len(image.points)

    def _locate(self, path: Path, images: list[ImageRecord]) -> tuple[list[ImageRecord], FileLookup, list[Path | None]]:
        """Return the images, renamed to match their files, and the files and masks of the images."""
        folder = find_image_folder(path, self.root)
        root = self.root if self.root and folder.is_relative_to(self.root) else folder.parent
        files = FileLookup(root, folder, [image.name for image in images])
        images = [image._replace(name=name) for image, name in zip(images, files.names, strict=True)]
        return images, files, find_masks(folder.with_name("masks"), files.names)


def read_camera_views(path: Path) -> tuple[list[View], PointCloud | None]:
    """Return a view without a photograph for each image of the largest model, and the points."""
    model, images = _read_largest_model(path)
    cameras, table = read_cameras(model), read_point_table(model)
    return [make_view(image, cameras) for image in images], table.to_point_cloud() if table else None


def make_tracks(images: Sequence[ImageRecord], table: PointTable, views: Sequence[View] = ()) -> Tracks | None:
    """Return the points that each image shows, or None if no image lists points.

    The reprojection residuals are included for images that have a view in `views`.
    """
    is_finite = table.is_finite()
    positions, ids = table.positions[is_finite], table.ids[is_finite]
    order = np.argsort(ids, kind="stable")
    track_rows, residuals, by_name = {}, {}, {view.name: view for view in views}
    for image in images:
        image_ids, first_indices = np.unique(image.points, return_index=True)
        nearest = np.minimum(np.searchsorted(ids[order], image_ids), max(len(ids) - 1, 0))
        is_match = ids[order][nearest] == image_ids if len(ids) else np.zeros(len(image_ids), bool)
        rows = track_rows[image.name] = order[nearest[is_match]] if len(ids) else np.empty(0, np.int64)
        view = by_name.get(image.name)
        if len(rows) and len(image.pixels) and view and not (view.lens and view.lens.is_wide):
            residuals[image.name] = reprojection_residuals(view, positions[rows], image.pixels[first_indices[is_match]])
    return Tracks(positions, track_rows, residuals) if any(map(len, track_rows.values())) else None


def find_models(path: Path) -> list[Path]:
    """Return the folders at and below `path` that contain a COLMAP model, sorted by name."""
    sparse = path / "sparse"
    folders = [path, sparse, *(sorted(sparse.iterdir()) if sparse.is_dir() else [])]
    counts = {folder: sum(find_file(folder, stem) is not None for stem in ("cameras", "images")) for folder in folders}
    models = [folder for folder, count in counts.items() if count == 2]
    return models or [folder for folder, count in counts.items() if count == 1 and find_file(folder, "points3D")]


def _read_largest_model(path: Path) -> tuple[Path, list[ImageRecord]]:
    models = [(folder, read_images(folder)) for folder in find_models(path)]
    if not models:
        raise DataError(
            f"{path}: no COLMAP model; expected cameras and images (.bin or .txt) in this folder, sparse, or sparse/0"
        )
    best = max(models, key=lambda model: len(model[1]))
    if unused_models := ", ".join(f"{folder} ({len(images)})" for folder, images in models if folder != best[0]):
        logger.info("%s: using the largest model, with %d images; ignoring %s", best[0], len(best[1]), unused_models)
    return best


def find_image_folder(path: Path, root: Path | None = None) -> Path:
    """Return `images` next to `sparse` if `path` is `sparse` or one of its models, otherwise `images` in `path`.

    If that folder does not exist, return the nearest `images` in a parent folder, up to `root`.
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
            f"{image.source}: image {quote(image.name)} has camera {image.camera}; expected an ID in the cameras file, "
            f"such as {sorted(cameras)[:8]}: {REMEDY}"
        )
    try:
        pose = pose_matrix(image.quaternion, image.translation)
    except ValueError as error:
        raise DataError(
            f"{image.source}: the pose of {quote(image.name)} is {error}: remove the image or {REMEDY}"
        ) from error
    lens = intern_lens(_make_lens(image.camera, cameras[image.camera]))
    camera, distortion = (lens.pinhole, lens) if lens.has_distortion else (lens.camera, None)
    return View(image.name, camera, pose, file, mask, lens=distortion)


def _make_lens(camera_id: int, camera: CameraRecord) -> Lens:
    """Return the lens of a camera.  Raises DataError for an invalid size or parameter."""
    size, focals = (camera.width, camera.height), camera.params[: LENS_MODELS[camera.model][0]]
    is_valid = min(size) > 0 and max(size) <= MAX_SIDE and min(focals) >= MIN_FOCAL
    if not is_valid or not all(abs(value) < MAX_VALUE for value in camera.params):
        raise DataError(
            f"{camera.source}: camera {camera_id} is {camera.width}x{camera.height} with parameters "
            f"{quote(camera.params)}; expected a positive size of at most {MAX_SIDE}, focal lengths of "
            f"at least {MIN_FOCAL:g}, and finite numbers: {REMEDY}"
        )
    if camera.model != "EQUIRECTANGULAR":
        return Lens(camera.width, camera.height, camera.model, camera.params)
    if camera.params != size:
        raise DataError(
            f"{camera.source}: camera {camera_id} is EQUIRECTANGULAR with parameters {quote(camera.params)}; expected "
            f"the size of its images, {camera.width}, {camera.height}: {REMEDY}"
        )
    return panorama_lens(*size)


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose, [3, 4], from a quaternion (w, x, y, z) of any nonzero length and a translation in scene units.

    Raises ValueError if values are missing or not finite, or if the quaternion is zero.
    """
    length = math.hypot(*quaternion)
    sizes = len(quaternion), len(translation)
    if sizes != (4, 3) or not 0 < length < math.inf or not all(abs(value) < MAX_VALUE for value in translation):
        raise ValueError(
            f"quaternion {quote(tuple(quaternion))}, translation {quote(tuple(translation))}; "
            "expected finite numbers and a quaternion that is not zero"
        )
    return np.column_stack([rotation_matrix(*(value / length for value in quaternion)), translation])
