"""Read the compressed PLY of PlayCanvas: 16 bytes per splat, plus 3(K-1) for SH, in chunks of 256 splats.

chunk   min and max of x y z, scale_x y z, and r g b, float32; without r g b (old files), colors range from 0 to 1
vertex  packed_position   x << 21 | y << 11 | z    11, 10, and 11 bits within the chunk's range
        packed_rotation   index of the largest of w x y z << 30, the others 10 bits each of c / sqrt 2 + 1/2
        packed_scale      log scales, packed like the position;    packed_color   r << 24 | g << 16 | b << 8 | opacity
sh      f_rest_i, uchar, channel-major: (byte + 1/2) / 256 of [-4, 4]; 0 and 255 are exactly -4 and 4
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.reading import open_file
from clsplat.formats.packing import from_smallest_three
from clsplat.formats.ply import MAX_HEADER, PlyHeader, parse_ply_header, read_rendering_comment, render_mode
from clsplat.formats.splats import (
    MAX_DEGREE,
    SH_C0,
    SplatFile,
    logits,
    reorder_columns,
    require_memory,
    require_size,
    sh_coefficients,
)

CHUNK = 256  # splats in a chunk
BITS = (11, 10, 11)  # bits of x, y, and z
SH_RANGE = 8.0  # size of the range of SH coefficients, from -4 to 4
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
AXES, SCALES, COLORS = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_BOUNDS = [f"{bound}_{name}" for group in (AXES, SCALES, COLORS) for bound in ("min", "max") for name in group]


def is_compressed(header: PlyHeader) -> bool:
    """Return whether the vertices of a PLY are packed splats."""
    return set(PACKED) <= set(header.dtype.names or ())


def read_compressed_ply(path: Path) -> SplatFile:
    """Read a compressed PLY.  Raises DataError if it is missing or damaged."""
    with open_file(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        size = file.seek(0, os.SEEK_END)
        tables = {}
        for name in filter(header.sections.__contains__, ("chunk", "vertex", "sh")):
            section = header.sections[name]
            length = section.count * section.dtype.itemsize
            require_size(path, size, section.start + length, f"{section.count} rows of '{name}'")
            file.seek(section.start)
            tables[name] = np.ndarray(section.count, section.dtype, file.read(length))
    chunks, vertices = _check_chunks(path, header, tables)
    require_memory(path, len(vertices), MAX_DEGREE if "sh" in tables else 0)
    chunk = np.repeat(np.arange(len(chunks)), CHUNK)[: len(vertices)]
    color, alpha = _decode_colors(vertices, chunks, chunk)
    parameters = {
        "means": _dequantize(_unpack(vertices["packed_position"], BITS), chunks, AXES, chunk).astype(np.float32),
        "quats": _decode_quats(vertices["packed_rotation"]),
        "log_scales": _dequantize(_unpack(vertices["packed_scale"], BITS), chunks, SCALES, chunk).astype(np.float32),
        "logit_opacity": logits(alpha[:, None]),
        "sh_base": ((color - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": _decode_harmonics(path, tables.get("sh"), len(vertices)),
    }
    return SplatFile(parameters, read_rendering_comment(path, header), render_mode(header))


def _check_chunks(path: Path, header: PlyHeader, tables: dict[str, NDArray[Any]]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the chunks and the vertices.  Raises DataError if either is missing, or if there are too few chunks."""
    if not {"chunk", "vertex"} <= tables.keys() or not set(_BOUNDS[:12]) <= set(tables["chunk"].dtype.names or ()):
        raise DataError(f"{path}: a compressed PLY needs the ranges of its splats in 'element chunk'; export it again")
    if not is_compressed(header) or any(header.dtype[name].str[1:] != "u4" for name in PACKED):
        raise DataError(f"{path}: expected 'property uint' for {', '.join(PACKED)}; export it again")
    chunks, vertices = tables["chunk"], tables["vertex"]
    if len(chunks) * CHUNK < len(vertices):
        raise DataError(
            f"{path}: has {len(chunks)} chunks for {len(vertices)} splats; expected one per {CHUNK}; export it again"
        )
    return chunks, vertices


def _decode_harmonics(path: Path, table: NDArray[Any] | None, count: int) -> NDArray[np.float32]:
    """Return the SH coefficients above band 0, coefficient-major, [count, 3(K-1)].  Raises DataError."""
    if table is None:
        return np.zeros((count, 0), np.float32)
    columns = len(table.dtype.names or ())
    names = tuple(f"f_rest_{i}" for i in range(columns))
    widths = [3 * (sh_coefficients(degree) - 1) for degree in range(MAX_DEGREE + 1)]
    if columns not in widths or table.dtype != np.dtype([(name, "u1") for name in names]) or len(table) != count:
        raise DataError(
            f"{path}: 'element sh' has {len(table)} rows of {columns} properties; expected {count} rows of "
            "9, 24, or 45 'property uchar f_rest_…', numbered from 0; export it again"
        )
    fractions = (np.arange(256) + 0.5) / 256
    fractions[0], fractions[255] = 0, 1
    levels = ((fractions - 0.5) * SH_RANGE).astype(np.float32)
    return reorder_columns(levels[table.view("u1").reshape(count, columns)], 3, columns // 3)


def _unpack(packed: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Unpack bit fields, the most significant first, as fractions in [0, 1], [N, fields].  bits: field widths."""
    columns, shift = [], 32
    for width in bits:
        shift -= width
        columns.append((packed.astype(np.uint32) >> np.uint32(shift) & np.uint32(2**width - 1)) / (2**width - 1))
    return np.stack(columns, axis=1)


def _dequantize(
    fractions: NDArray[np.float64], chunks: NDArray[Any], names: tuple[str, ...], chunk_index: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Scale fractions in [0, 1] to the range of each splat's chunk, [N, columns].  chunk_index: [N]."""
    low, high = (np.stack([chunks[f"{b}_{n}"] for n in names], axis=1).astype(np.float64) for b in ("min", "max"))
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are rejected later
        values: NDArray[np.float64] = low[chunk_index] + fractions * (high - low)[chunk_index]
    return values


def _decode_colors(
    vertices: NDArray[Any], chunks: NDArray[Any], chunk_index: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the colors, [N, 3], and opacities, [N]."""
    fractions = _unpack(vertices["packed_color"], (8, 8, 8, 8))
    if set(_BOUNDS[12:]) <= set(chunks.dtype.names or ()):
        return _dequantize(fractions[:, :3], chunks, COLORS, chunk_index), fractions[:, 3]
    return fractions[:, :3], fractions[:, 3]


def _decode_quats(packed: NDArray[Any]) -> NDArray[np.float32]:
    fractions = _unpack(packed << np.uint32(2), (10, 10, 10))
    return from_smallest_three((packed >> np.uint32(30)).astype(np.intp), (fractions - 0.5) * 2**0.5)
