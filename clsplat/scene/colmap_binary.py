"""Read the binary files of a COLMAP model; every number is checked against the end of the file."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import DataError
from clsplat.reading import read_file
from clsplat.scene.colmap_records import MODELS, REMEDY, CameraRecord, ImageRecord, decode, parameter_count
from clsplat.scene.points import PointTable

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
