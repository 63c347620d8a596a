"""Read the text files of a COLMAP model."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, shortened
from clsplat.reading import read_file
from clsplat.scene.colmap_records import REMEDY, CameraRecord, ImageRecord, decode, parameter_count
from clsplat.scene.points import PointTable

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
        raise DataError(
            f"{where}: {shortened(str(error))}; expected {layout}: remove that entry or {REMEDY}"
        ) from error


def _id(word: str) -> int:
    """The id of a point; those that COLMAP does not give are one."""
    return min(max(int(word), -1), LARGEST_ID)


def _byte(word: str) -> int:
    if not 0 <= int(word) <= 255:
        raise ValueError(f"colour {word} is not in 0..255")
    return int(word)
