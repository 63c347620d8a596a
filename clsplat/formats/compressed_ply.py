"""PlayCanvas' compressed PLY: 16 bytes a splat, and 3(K-1) for its harmonics, in chunks of 256 with their own ranges.

chunk   min and max of x y z, scale_x y z and r g b, float32; old files have no colors, whose range is then [0, 1]
vertex  packed_position   x << 21 | y << 11 | z    11, 10 and 11 bits of the chunk's range
        packed_rotation   index of the largest of w x y z << 30, the others 10 bits each of c / sqrt 2 + 1/2
        packed_scale      logarithms, as the position;    packed_color   r << 24 | g << 16 | b << 8 | opacity
sh      f_rest_i, uchar, channel-major: (byte + 1/2) / 256 of [-4, 4]; 0 and 255 are the ends
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.reading import open_file
from clsplat.formats.packing import from_smallest_three, morton_order, smallest_three, written
from clsplat.formats.ply import (
    MAX_HEADER,
    PlyHeader,
    comment_of,
    comments,
    format_ply_header,
    mode_of,
    parse_ply_header,
)
from clsplat.formats.splats import (
    MAX_DEGREE,
    SH_C0,
    SplatFile,
    Writing,
    logits,
    opacities,
    require_held,
    sh_coefficients,
    swapped,
    unit,
)

CHUNK = 256  # splats
BITS = (11, 10, 11)  # of x, y and z
MAX_LOG_SCALE = 20.0
SH_RANGE = 8.0  # from -4 to 4
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
AXES, SCALES, COLORS = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_ENDS = [f"{end}_{name}" for group in (AXES, SCALES, COLORS) for end in ("min", "max") for name in group]


def is_compressed(header: PlyHeader) -> bool:
    """Return whether a PLY holds packed splats."""
    return set(PACKED) <= set(header.dtype.names or ())


def read_compressed_ply(path: Path) -> SplatFile:
    """Read a compressed PLY.  Raises DataError when it is missing or damaged."""
    with open_file(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        size = file.seek(0, os.SEEK_END)
        tables = {}
        for name in ("chunk", "vertex", "sh"):
            if (section := header.sections.get(name)) is None:
                continue
            length = section.count * section.dtype.itemsize
            require_held(path, size, section.start + length, f"{section.count} rows of '{name}'")
            file.seek(section.start)
            tables[name] = np.ndarray(section.count, section.dtype, file.read(length))
    chunks, vertices = _checked(path, header, tables)
    per_splat = np.repeat(np.arange(len(chunks)), CHUNK)[: len(vertices)]
    color, alpha = _colors(vertices, chunks, per_splat)
    rest = _harmonics(path, tables.get("sh"), len(vertices))
    parameters = {
        "means": _ranged(vertices["packed_position"], chunks, AXES, per_splat),
        "quats": _quaternions(vertices["packed_rotation"]),
        "log_scales": _ranged(vertices["packed_scale"], chunks, SCALES, per_splat),
        "logit_opacity": logits(alpha[:, None]),
        "sh_base": ((color - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": rest,
    }
    return SplatFile(parameters, comment_of(path, header), mode_of(header))


def write_compressed_ply(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write splats along a Morton curve.  Raises OutputError."""
    p = splats.rows(morton_order(splats.parameters["means"])).parameters
    count = len(p["means"])
    color = p["sh_base"].astype(np.float64) * SH_C0 + 0.5
    scales = np.clip(p["log_scales"], -MAX_LOG_SCALE, MAX_LOG_SCALE)
    chunks = np.concatenate([_ends(table) for table in (p["means"], scales, color)], axis=1)
    position, scale = (_packed(_shares(table), BITS) for table in (p["means"], scales))
    alpha = opacities(p["logit_opacity"])
    colors = _packed(np.concatenate([_shares(color), alpha], axis=1), (8, 8, 8, 8))
    vertices = np.stack([position, _packed_rotation(p["quats"]), scale, colors], axis=1)
    rest = swapped(p["sh_rest"], p["sh_rest"].shape[1] // 3, 3).astype(np.float64)
    sh = np.clip(np.floor((rest / SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)
    elements = {
        "chunk": (len(chunks), [f"float {name}" for name in _ENDS]),
        "vertex": (count, [f"uint {name}" for name in PACKED]),
    }
    if sh.shape[1]:
        elements["sh"] = count, [f"uchar f_rest_{i}" for i in range(sh.shape[1])]
    with written(path) as file:
        file.write(format_ply_header(comments(splats.rendering), **elements))
        for table, kind in ((chunks, "<f4"), (vertices, "<u4"), (sh, "u1")):
            file.write(np.ascontiguousarray(table, kind).tobytes())
    return file.sha256


def _checked(path: Path, header: PlyHeader, tables: dict[str, NDArray[Any]]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Chunks and vertices.  Raises DataError where they do not fit each other."""
    if not {"chunk", "vertex"} <= tables.keys() or not set(_ENDS[:12]) <= set(tables["chunk"].dtype.names or ()):
        raise DataError(f"{path}: a compressed PLY without 'element chunk', the ranges of its splats; export it again")
    if not is_compressed(header) or any(header.dtype[name].str[1:] != "u4" for name in PACKED):
        raise DataError(f"{path}: expected 'property uint' for {', '.join(PACKED)}; export it again")
    chunks, vertices = tables["chunk"], tables["vertex"]
    if len(chunks) * CHUNK < len(vertices):
        raise DataError(
            f"{path}: {len(chunks)} chunks for {len(vertices)} splats; expected one for {CHUNK}: export it again"
        )
    return chunks, vertices


def _harmonics(path: Path, table: NDArray[Any] | None, count: int) -> NDArray[np.float32]:
    """The bands above 0, coefficient-major, [count, 3(K-1)]."""
    if table is None:
        return np.zeros((count, 0), np.float32)
    columns = len(table.dtype.names or ())
    names = tuple(f"f_rest_{i}" for i in range(columns))
    widths = [3 * (sh_coefficients(degree) - 1) for degree in range(MAX_DEGREE + 1)]
    if columns not in widths or table.dtype != np.dtype([(name, "u1") for name in names]) or len(table) != count:
        raise DataError(
            f"{path}: 'element sh' has {len(table)} rows of {columns} properties; expected {count} rows of "
            "9, 24 or 45 'property uchar f_rest_…', numbered from 0 on: export it again"
        )
    share = (np.arange(256) + 0.5) / 256
    share[0], share[255] = 0, 1
    levels = ((share - 0.5) * SH_RANGE).astype(np.float32)
    return swapped(levels[table.view("u1").reshape(count, columns)], 3, columns // 3)


def _fields(packed: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Numbers in [0, 1] of so many bits each, the first in the highest, [N, fields]."""
    columns, shift = [], 32
    for width in bits:
        shift -= width
        columns.append((packed.astype(np.uint32) >> np.uint32(shift) & np.uint32(2**width - 1)) / (2**width - 1))
    return np.stack(columns, axis=1)


def _packed(shares: NDArray[np.floating], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """What `_fields` unpacks, rounded."""
    found, shift = np.zeros(len(shares), np.uint32), 32
    for i, width in enumerate(bits):
        shift -= width
        levels = np.clip(np.floor(shares[:, i] * (2**width - 1) + 0.5), 0, 2**width - 1)
        found |= levels.astype(np.uint32) << np.uint32(shift)
    return found


def _ranged(
    packed: NDArray[Any], chunks: NDArray[Any], names: tuple[str, ...], per_splat: NDArray[np.integer]
) -> NDArray[np.float32]:
    """Positions or logarithms of scales, [N, 3]."""
    return _spread(_fields(packed, BITS), chunks, names, per_splat).astype(np.float32)


def _spread(
    shares: NDArray[np.float64], chunks: NDArray[Any], names: tuple[str, ...], per_splat: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Values of shares of the range of each splat's chunk."""
    low, high = (np.stack([chunks[f"{end}_{n}"] for n in names], axis=1).astype(np.float64) for end in ("min", "max"))
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        values: NDArray[np.float64] = low[per_splat] + shares * (high - low)[per_splat]
    return values


def _colors(
    vertices: NDArray[Any], chunks: NDArray[Any], per_splat: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Colors, [N, 3], and opacities, [N]."""
    shares = _fields(vertices["packed_color"], (8, 8, 8, 8))
    if set(_ENDS[12:]) <= set(chunks.dtype.names or ()):
        return _spread(shares[:, :3], chunks, COLORS, per_splat), shares[:, 3]
    return shares[:, :3], shares[:, 3]


def _quaternions(packed: NDArray[Any]) -> NDArray[np.float32]:
    shares = _fields(packed << np.uint32(2), (10, 10, 10))
    return from_smallest_three((packed >> np.uint32(30)).astype(np.intp), (shares - 0.5) * 2**0.5)


def _packed_rotation(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    largest, others = smallest_three(unit(quats))
    return _packed(others * 0.5**0.5 + 0.5, (10, 10, 10)) >> np.uint32(2) | largest.astype(np.uint32) << np.uint32(30)


def _ends(table: NDArray[np.floating]) -> NDArray[np.float32]:
    """Smallest and largest values of each chunk, [chunks, 2 * components] float32."""
    starts = np.arange(0, len(table), CHUNK)
    if not len(table):
        return np.zeros((0, 2 * table.shape[1]), np.float32)
    ends = [np.minimum.reduceat(table, starts), np.maximum.reduceat(table, starts)]
    return np.concatenate(ends, axis=1).astype(np.float32)


def _shares(table: NDArray[np.floating]) -> NDArray[np.float64]:
    """Where each value lies in the range of its chunk, in [0, 1]; 0 where the range is nothing."""
    ends = np.repeat(_ends(table), CHUNK, axis=0)[: len(table)].astype(np.float64)
    low, high = np.split(ends, 2, axis=1)
    extent = high - low
    return np.divide(table - low, extent, out=np.zeros(table.shape), where=extent >= 1e-5)
