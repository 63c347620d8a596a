"""Read and write sparse coloured points as PLY."""

import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.files import atomic
from clsplat.scene.images import read_file
from clsplat.scene.scene import Floats, PointCloud

logger = logging.getLogger("clsplat")

FAR = 1e15  # scene units; a float holds no square of much larger ones
COUNT = re.compile("[0-9]{1,18}")
HEADER_LIMIT = 1 << 16  # bytes; a real header holds a few hundred
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
POINT = np.dtype([(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])


def point_cloud(path: Path, positions: Floats, rgb: NDArray[Any]) -> PointCloud:
    """Return points from positions [M, 3] and colours [M, 3] in 0..255; those not finite are dropped and logged."""
    kept = (np.abs(positions) < FAR).all(axis=1)
    if not kept.all():
        logger.warning("%s: dropped %d points that are not finite", path, np.count_nonzero(~kept))
    return PointCloud(np.asarray(positions[kept], np.float32), np.asarray(rgb[kept], np.float32) / np.float32(255))


def read_points_ply(path: Path) -> PointCloud:
    """Read x y z and red green blue (uchar) of the first element of a PLY file; other properties are ignored.

    Raises DataError when the file is damaged, big-endian, or lacks these properties.
    """
    return point_cloud(path, *read_ply_table(path))


def read_ply_table(path: Path) -> tuple[Floats, NDArray[Any]]:
    """Return positions [M, 3] and colours [M, 3] in 0..255 of a PLY file as they are; raises as read_points_ply."""
    data = read_file(path)
    form, count, dtype, start = _parse_header(path, data)
    missing = [name for name in POINT.names or () if name not in (dtype.names or ())]
    if missing or any(dtype[name] != np.uint8 for name in ("red", "green", "blue")):
        raise DataError(f"{path}: expected x y z and uchar red green blue of each vertex, found {dtype.names}")
    rows = _read_ascii if form == "ascii" else _read_binary
    table = rows(path, data[start:], count, dtype)
    positions = np.stack([table[name] for name in "xyz"], axis=1)
    rgb = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
    return positions, rgb


def write_points_ply(path: Path, points: PointCloud) -> None:
    """Write points as binary little-endian PLY.  Raises OutputError when that fails."""
    table = np.empty(len(points), POINT)
    for i, name in enumerate("xyz"):
        table[name] = points.positions[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        table[name] = np.rint(points.colours[:, i] * 255)
    properties = [f"property {'uchar' if POINT[name] == np.uint8 else 'float'} {name}" for name in POINT.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    with atomic(path) as file:
        file.write("\n".join(lines).encode() + table.tobytes())


def _parse_header(path: Path, data: bytes) -> tuple[str, int, np.dtype[Any], int]:
    """Return the format, the number of vertices, the type of one vertex and where the first one starts."""
    end = data.find(b"end_header", 0, HEADER_LIMIT)
    start = data.find(b"\n", end, HEADER_LIMIT) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise DataError(f"{path}: not a PLY file: expected a header from 'ply' to 'end_header'; export it again")
    form, count, fields, elements = "", -1, [], 0
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), start=1):
        match line.split():
            case ["format", ("ascii" | "binary_little_endian") as form, _]:
                pass
            case ["element", name, amount] if elements > 0 or (name == "vertex" and COUNT.fullmatch(amount)):
                count = count if elements else int(amount)
                elements += 1
            case ["property", kind, name] if kind in TYPES:
                fields += [(name, "<" + TYPES[kind])] if elements == 1 else []
            case ["property", "list", *_] if elements > 1:
                pass  # a face list, after the vertices
            case [] | ["ply"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise DataError(
                    f"{path}: line {number}: '{line[:80]}'; expected a PLY header, ascii or binary_little_endian, "
                    "with `element vertex` first and without lists: export it again"
                )
    if not form or not fields or len({name for name, _ in fields}) < len(fields):
        raise DataError(f"{path}: the PLY header lacks its format or its vertices, or repeats a property")
    return form, count, np.dtype(fields), start


def _require(path: Path, count: int, stride: int, size: int) -> None:
    if count * stride > size:
        raise DataError(
            f"{path}: {count} points need {count * stride} bytes, {size} follow the header; "
            "the file is truncated or damaged: copy or export it again"
        )


def _read_binary(path: Path, body: bytes, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the vertices as a structured array, [count]."""
    _require(path, count, dtype.itemsize, len(body))
    return np.frombuffer(body, dtype, count)


def _read_ascii(path: Path, body: bytes, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the vertices, one per line, as a structured array, [count]."""
    # A number takes a digit and a blank, but the last blank may be missing.
    _require(path, count, 2 * len(dtype.fields or ()), len(body) + 1)
    if count == 0:
        return np.empty(0, dtype)
    try:
        table = np.loadtxt(io.BytesIO(body), dtype, comments=None, max_rows=count, ndmin=1)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: {error} after the header; expected one number for each property") from error
    if len(table) < count:
        raise DataError(f"{path}: expected {count} lines after the header, found {len(table)}; the file is truncated")
    return table
