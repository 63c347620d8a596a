"""Read the three files of a COLMAP model, binary or text, without believing any number they hold.

COLMAP 3.12 and later also write `rigs` and `frames`.  They can be left alone: `images` still holds the composed
world-to-camera pose of every registered image (tests compare it with pycolmap on such folders).
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clsplat.errors import DataError
from clsplat.scene.images import read_file
from clsplat.scene.points import PointTable
from clsplat.scene.scene import PointCloud

# Camera models in order of their ids, with the number of parameters (COLMAP 4, sensor/models.h).
PARAMETERS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}
MODELS = list(PARAMETERS)
REMEDY = "copy or export the model again"
POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class CameraRecord(NamedTuple):
    """A line of `cameras`; `where` is its place, for messages."""

    where: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """A line of `images`: quaternion (w, x, y, z) and translation, world to camera.

    `observed` counts its 2D points that show a 3D point.
    """

    where: str
    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    observed: int = 0


def find_file(folder: Path, stem: str) -> Path | None:
    """Return `stem`.bin or else `stem`.txt in a folder, or None."""
    files = (folder / f"{stem}.bin", folder / f"{stem}.txt")
    return next((file for file in files if file.is_file()), None)


def read_cameras(folder: Path) -> dict[int, CameraRecord]:
    """Return the cameras of a model by their ids.  Raises DataError, as all here, when the file is damaged."""
    file = _require_file(folder, "cameras")
    cameras: dict[int, CameraRecord] = {}
    for number, camera in _cameras_binary(file) if file.suffix == ".bin" else _cameras_text(file):
        if number in cameras:
            raise DataError(f"{camera.where}: a second camera {number}; expected different ids: {REMEDY}")
        cameras[number] = camera
    return cameras


def read_images(folder: Path) -> list[ImageRecord]:
    """Return the registered images of a model, in the order of the file."""
    file = _require_file(folder, "images")
    return list(_images_binary(file) if file.suffix == ".bin" else _images_text(file))


def read_points(folder: Path) -> PointCloud | None:
    """Return the points of a model, or None when there are none."""
    table = read_point_table(folder)
    if table is None:
        return None
    points = table.cloud()
    return points if len(points) else None


def read_point_table(folder: Path) -> PointTable | None:
    """Return the points of a model with their errors, or None when it has no such file."""
    file = find_file(folder, "points3D")
    if file is None:
        return None
    return _points_binary(file) if file.suffix == ".bin" else _points_text(file)


def _require_file(folder: Path, stem: str) -> Path:
    file = find_file(folder, stem)
    if file is None:
        raise DataError(f"{folder}: no {stem}.bin or {stem}.txt; {REMEDY}")
    return file


class _Binary:
    """A binary file walked from front to back; each step is checked against the end of the file first."""

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
        return _decode(where, self.data[start:end])

    def finish(self) -> None:
        if self.at < len(self.data):
            raise DataError(f"{self.where}: {len(self.data) - self.at} bytes follow the last record; damaged: {REMEDY}")


def _cameras_binary(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    file = _Binary(path)
    for _ in range(file.count(24, "cameras")):
        where = file.where
        number, model, width, height = file.take("<IiQQ", "a camera")
        name = MODELS[model] if 0 <= model < len(MODELS) else str(model)
        params = file.take(f"<{_parameters(where, name)}d", "camera parameters")
        yield number, CameraRecord(where, name, width, height, params)
    file.finish()


def _images_binary(path: Path) -> Iterator[ImageRecord]:
    file = _Binary(path)
    for _ in range(file.count(73, "images")):
        where = file.where
        _, *pose, camera = file.take("<I7dI", "an image")
        name = file.text("an image name")
        count = file.count(POINT2D.itemsize, "2D points")
        start = file.skip(POINT2D.itemsize * count, "2D points")
        observed = int(np.count_nonzero(np.frombuffer(file.data, POINT2D, count, start)["point"] >= 0))
        yield ImageRecord(where, name, camera, tuple(pose[:4]), tuple(pose[4:]), observed)
    file.finish()


def _points_binary(path: Path) -> PointTable:
    file = _Binary(path)
    starts = np.empty(file.count(POINT.itemsize, "points"), np.int64)
    for i in range(len(starts)):  # a point ends where its track does, so only the walk is a loop
        starts[i] = file.skip(POINT.itemsize - 8, "a point")
        file.skip(8 * file.count(8, "track elements"), "track elements")
    file.finish()
    if len(starts) == 0:
        return PointTable(path, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    records = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, np.uint8), POINT.itemsize)
    table = records[starts].view(POINT)[:, 0]
    return PointTable(path, table["position"], table["rgb"], table["error"])


def _cameras_text(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    for where, line in _lines(path):
        if line:
            layout = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
            words = line.split()
            number, model, width, height = _convert(where, words[:4], (int, str, int, int), layout)
            params = _convert(where, words[4:], [float] * _parameters(where, model), f"the parameters of {model}")
            yield number, CameraRecord(where, model, width, height, tuple(params))


def _images_text(path: Path) -> Iterator[ImageRecord]:
    layout = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    kinds = (int, *[float] * 7, int, str)
    image: ImageRecord | None = None  # whose points may follow
    for where, line in _lines(path):
        if image and _is_points2d(line):
            yield image._replace(observed=sum(not word.startswith("-") for word in line.split()[2::3]))
            image = None
        elif line:
            if image:
                yield image
            _, *pose, camera, name = _convert(where, line.split(maxsplit=9), kinds, layout)
            image = ImageRecord(where, name, camera, tuple(pose[:4]), tuple(pose[4:]))
    if image:
        yield image


def _is_points2d(line: str) -> bool:
    """Tell the line of 2D points, (X, Y, POINT3D_ID) each, perhaps none, from the next image: some writers omit it."""
    words = line.split()
    return len(words) % 3 == 0 and (not words or words[-1].lstrip("-").isdecimal())


def _points_text(path: Path) -> PointTable:
    kinds = (int, float, float, float, _byte, _byte, _byte, float)
    layout = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
    rows = [_convert(where, line.split(maxsplit=8)[:8], kinds, layout)[1:] for where, line in _lines(path) if line]
    table = np.array(rows, np.float64).reshape(-1, 7)
    return PointTable(path, table[:, :3], table[:, 3:6], table[:, 6])


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of every line that is not a comment."""
    text = _decode(str(path), read_file(path)).lstrip("\ufeff")
    for number, line in enumerate(map(str.strip, text.split("\n")), start=1):
        if not line.startswith("#"):
            yield f"{path}: line {number}", line


def _convert(where: str, words: list[str], kinds: Sequence[Callable[[str], Any]], layout: str) -> list[Any]:
    """Turn each word into its kind.  Raises DataError naming the line."""
    if len(words) != len(kinds):
        raise DataError(f"{where}: expected {layout}, found {len(words)} of {len(kinds)} words; {REMEDY}")
    try:
        return [kind(word) for kind, word in zip(kinds, words, strict=True)]
    except ValueError as error:
        raise DataError(f"{where}: {error}; expected {layout}: remove that entry or {REMEDY}") from error


def _byte(word: str) -> int:
    if not 0 <= int(word) <= 255:
        raise ValueError(f"colour {word} is not in 0..255")
    return int(word)


def _parameters(where: str, model: str) -> int:
    if model not in PARAMETERS:
        raise DataError(f"{where}: unknown camera model '{model}'; expected one of {', '.join(PARAMETERS)}")
    return PARAMETERS[model]


def _decode(where: str, data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not UTF-8 text ({error}); {REMEDY}") from error
