"""Read and write sparse colored points as PLY."""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote
from clsplat.core.files import open_atomic
from clsplat.core.reading import read_file
from clsplat.formats.ply import format_ply_header, parse_ply_header, read_ascii
from clsplat.formats.splats import require_size
from clsplat.scene.scene import PointCloud
from clsplat.scene.times import Clock
from clsplat.scene.view import Floats

logger = logging.getLogger("clsplat")

MAX_VALUE = 1e15  # largest number in a dataset; the squares of much larger numbers overflow float32
BELOW_MAX = f"a number between -{MAX_VALUE:g} and {MAX_VALUE:g}"
RGB = ("red", "green", "blue")
TIME = "time"  # name of the property with the time of a point, in the unit of the frame times
POINT = np.dtype([(name, "<f4") for name in "xyz"] + [(name, "u1") for name in RGB])
TIMED_POINT = np.dtype([*POINT.descr, (TIME, "<f4")])


class PointTable(NamedTuple):
    """All points of a dataset, including invalid ones."""

    file: Path
    positions: Floats  # [M, 3]
    rgb: NDArray[Any]  # [M, 3], in 0..255
    error: Floats = np.empty(0)  # [M] mean reprojection error, px, or [0]; COLMAP writes -1 or 0 if unknown
    ids: NDArray[np.int64] = np.empty(0, np.int64)  # [M] ids that images refer to, or [0]
    times: Floats = np.empty(0)  # [M] in the unit of the frame times, or [0]

    def is_finite(self) -> NDArray[np.bool_]:
        """Return a mask of the finite points, [M]."""
        is_finite = (np.abs(self.positions) < MAX_VALUE).all(axis=1)
        return np.asarray(is_finite & (np.abs(self.times) < MAX_VALUE) if len(self.times) else is_finite)

    def to_point_cloud(self, clock: Clock | None = None) -> PointCloud:
        """Return the finite points, and log how many points are dropped.

        clock: the clock of the frames; without a clock, the points have no times.  Raises DataError if the times of the
        points are in a different unit from the frames' times.
        """
        is_finite, times = self.is_finite(), None
        if not is_finite.all():
            logger.warning("%s: dropped %s points that are not finite", self.file, f"{np.count_nonzero(~is_finite):,}")
        colors = np.asarray(self.rgb[is_finite], np.float32) / np.float32(255)
        if clock and len(self.times):
            times = np.asarray(clock.normalize_points(self.file, self.times[is_finite]), np.float32)
        return PointCloud(self.positions[is_finite], colors, times)


def read_points_ply(path: Path, clock: Clock | None = None) -> PointCloud:
    """Read the positions, the colors and, with a clock, the times of the vertices of a PLY file.

    The vertices need the properties x y z and uchar red green blue; other properties are ignored.  Raises DataError if
    the file is damaged, is big-endian or lacks these properties, or if the times are in a different unit from the
    frames' times.
    """
    return read_ply_table(path).to_point_cloud(clock)


def read_ply_table(path: Path) -> PointTable:
    """Return all points of a PLY file, including invalid ones.  Raises DataError like read_points_ply."""
    data = read_file(path)
    header = parse_ply_header(path, data)
    if header.format == "binary_big_endian":
        raise DataError(f"{path}: is big-endian; expected ascii or binary_little_endian: export it again")
    names = header.dtype.names or ()
    if not set(POINT.names or ()) <= set(names) or any(header.dtype[name] != np.uint8 for name in RGB):
        raise DataError(
            f"{path}: expected vertices with x y z and uchar red green blue, found {quote(names)}; export it again"
        )
    if header.format == "ascii":
        table = read_ascii(path, data, header)
    else:
        require_size(path, len(data), header.start + header.count * header.dtype.itemsize, f"{header.count} points")
        table = np.frombuffer(data, header.dtype, header.count, header.start)
    positions, rgb = (np.stack([table[name] for name in names], axis=1) for names in ("xyz", RGB))
    times = np.asarray(table[TIME], np.float64) if TIME in names else np.empty(0)
    return PointTable(path, positions, rgb, times=times)


def write_points_ply(path: Path, points: PointCloud) -> None:
    """Write points, including their times if they have any, as binary little-endian PLY.  Raises OutputError."""
    dtype = POINT if points.times is None else TIMED_POINT
    if points.positions.dtype == np.float64:  # world coordinates, for which float32 may be too coarse
        dtype = np.dtype([(name, "<f8" if name in "xyz" else dtype[name]) for name in dtype.names or ()])
    table = np.empty(len(points), dtype)
    if points.times is not None:
        table[TIME] = points.times
    for i, name in enumerate("xyz"):
        table[name] = points.positions[:, i]
    for i, name in enumerate(RGB):
        table[name] = np.rint(points.colors[:, i] * 255)
    ply_types = {"|u1": "uchar", "<f4": "float", "<f8": "double"}
    properties = [f"{ply_types[dtype[name].str]} {name}" for name in dtype.names or ()]
    with open_atomic(path) as file:
        file.write(format_ply_header((), vertex=(len(points), properties)) + table.tobytes())
