"""The PLY layout of the 3DGS reference: written in its order, read by property name in any order.

    x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3    float32, before activation

f_rest is channel-major (all red, all green, all blue); opacity is a logit, scales are logarithms, rot is (w, x, y, z).
Normals are written as zeros.  Where a world filter is not yet part of scales and opacity, `filter_3D` follows, its
standard deviation (Mip-Splatting); where Gaussians move, the columns of their motion (clsplat/formats/motion.py).
Comments hold the numbers that a rasterizer needs, and the mode for viewers: `SplatRenderMode: mip` when a screen filter
reduces opacities to keep their energy, else `default`.
"""

import json
import os
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted
from clsplat.formats.motion import MOTION, columns_among, columns_of
from clsplat.formats.output import written
from clsplat.formats.splats import (
    FLAT_LOG_SCALE,
    MAX_DEGREE,
    PARAMETERS,
    Parameters,
    SplatFile,
    require_held,
    sh_coefficients,
    swapped,
)
from clsplat.ply_header import MAX_HEADER, PlyHeader, format_ply_header, parse_ply_header
from clsplat.reading import opened

RENDERING, MODE = "clsplat ", "SplatRenderMode: "  # comments
MIP = re.compile(r"SplatRenderMode\s*:\s*mip|postshot\.anti_aliasing\s*=\s*1", re.IGNORECASE)  # of all programs
FILTER = "filter_3D"
NUMBERS = ("near", "screen_variance", "compensate", "pixel_box")  # of the comment
ROWS = 65_536  # in memory twice, as they are read and written
MAX_NUMBER = 1e15  # as of any number in a dataset
_COLUMNS = {
    "means": ("x", "y", "z"),
    "sh_base": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacity": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}


def read_ply(path: Path) -> SplatFile:
    """Read a splat PLY; of a disc, which has no scale_2, the third axis is FLAT_LOG_SCALE.

    Raises DataError when it is missing, damaged or not a splat.
    """
    with opened(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        if header.format == "ascii":
            raise DataError(f"{path}: is an ascii PLY; expected binary_little_endian or big_endian: export it again")
        rendering, size = comment_of(path, header), header.count * header.dtype.itemsize
        require_held(path, file.seek(0, os.SEEK_END), header.start + size, f"{header.count} splats")
        file.seek(header.start)
        parameters = _read(path, file, header)
    return SplatFile(parameters, rendering, "mip" if "filter_variance" in parameters else mode_of(header))


def write_ply(path: Path, parameters: Parameters, rendering: dict[str, Any]) -> str:
    """Write parameters in the reference's order, and filter_variance where it is given; return the SHA-256 of the file.

    `rendering` becomes a comment in JSON; with `compensate` in it, the file's mode is mip.  Raises OutputError.
    """
    count = len(parameters["means"])
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(parameters["sh_rest"].shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    names += [FILTER] if "filter_variance" in parameters else []
    names += columns_of(parameters[MOTION].shape[1]) if MOTION in parameters else ()
    with written(path) as file:
        file.write(format_ply_header(comments(rendering), vertex=(count, (f"float {name}" for name in names))))
        for first in range(0, count, ROWS):
            file.write(_body({name: table[first : first + ROWS] for name, table in parameters.items()}))
    return file.sha256


def _body(parameters: Parameters) -> bytes:
    """The rows of a file."""
    count, rest = parameters["sh_rest"].shape
    blocks = [
        parameters["means"],
        np.zeros((count, 3), np.float32),
        parameters["sh_base"],
        swapped(parameters["sh_rest"], rest // 3, 3),
        parameters["logit_opacity"],
        parameters["log_scales"],
        parameters["quats"],
    ]
    blocks += [np.sqrt(parameters["filter_variance"])] if "filter_variance" in parameters else []
    blocks += [parameters[MOTION]] if MOTION in parameters else []
    return np.ascontiguousarray(np.concatenate(blocks, axis=1), "<f4").tobytes()


def comments(rendering: dict[str, Any]) -> list[str]:
    """Return the comments of a header that say how a model is rendered."""
    mode = "mip" if rendering.get("compensate") else "default"
    return [f"{RENDERING}{json.dumps(rendering, sort_keys=True, allow_nan=False)}", f"{MODE}{mode}"]


def mode_of(header: PlyHeader) -> str:
    """Return `mip` where a comment of any program says so, else `default`."""
    return "mip" if any(MIP.match(text) for text in header.comments) else "default"


def comment_of(path: Path, header: PlyHeader) -> dict[str, Any]:
    """Return the numbers of our comment; none where there is another.  Raises DataError for an invalid one."""
    text = next((text.removeprefix(RENDERING) for text in header.comments if text.startswith(RENDERING)), "")
    try:
        values = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return {}
    return checked_numbers(path, values) if isinstance(values, dict) else {}


def checked_numbers(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return what a file says about rendering.  Raises DataError for an invalid number."""
    for name in NUMBERS:
        value = values.get(name)
        if value is not None and (not isinstance(value, int | float) or not 0 <= value < MAX_NUMBER):
            raise DataError(
                f"{path}: its comment says {name} = {quoted(value)}; expected a number from 0 to {MAX_NUMBER:g}: "
                "export it again, or correct that line"
            )
    try:
        json.dumps(values, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: its comment holds what no JSON holds ({quoted(error)}); export it again, or correct it"
        ) from error
    return values


def _read(path: Path, file: BinaryIO, header: PlyHeader) -> Parameters:
    """The tables of a file that stands at its first row, read some rows at a time."""
    tables: Parameters = {}
    for first in range(0, max(header.count, 1), ROWS):
        rows = min(ROWS, header.count - first)
        part = _parameters(path, np.frombuffer(file.read(rows * header.dtype.itemsize), header.dtype))
        if not tables:
            tables = {name: np.empty((header.count, table.shape[1]), table.dtype) for name, table in part.items()}
        for name, table in part.items():
            tables[name][first : first + rows] = table
    return tables


def _parameters(path: Path, vertices: NDArray[Any]) -> Parameters:
    names = vertices.dtype.names or ()
    columns_of = dict(_COLUMNS)
    if "scale_1" in names and "scale_2" not in names:  # 2DGS
        columns_of["log_scales"] = ("scale_0", "scale_1")
    missing = [column for columns in columns_of.values() for column in columns if column not in names]
    if missing:
        raise DataError(
            f"{path}: not a splat file: it has no {', '.join(missing[:4])}{' …' if len(missing) > 4 else ''}; "
            "train from a point cloud with `clsplat run`"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    degree = next((d for d in range(MAX_DEGREE + 1) if 3 * (sh_coefficients(d) - 1) == rest), None)
    columns = tuple(f"f_rest_{i}" for i in range(rest))
    if degree is None or not set(columns) <= set(names):
        raise DataError(
            f"{path}: has {rest} f_rest properties; expected 0, 9, 24 or 45, numbered from 0 on: export it again"
        )
    parameters = {name: _columns(vertices, columns) for name, columns in columns_of.items()}
    by_channel = _columns(vertices, columns)
    per_channel = sh_coefficients(degree) - 1
    parameters["sh_rest"] = swapped(by_channel, 3, per_channel)
    if parameters["log_scales"].shape[1] == 2:
        parameters["log_scales"] = np.pad(parameters["log_scales"], ((0, 0), (0, 1)), constant_values=FLAT_LOG_SCALE)
    parameters = {name: parameters[name] for name in PARAMETERS}
    if FILTER in names:
        with np.errstate(over="ignore"):  # infinity is refused
            parameters["filter_variance"] = np.square(_columns(vertices, (FILTER,)))
    moving = columns_among(names)
    if moving is None:
        raise DataError(
            f"{path}: has some properties of a motion and lacks others; expected velocity_0..2, time_centre and "
            "log_duration, and none or all of acceleration_0..2, jerk_0..2 and turn_0..3: export it again"
        )
    return {**parameters, MOTION: _columns(vertices, moving)} if moving else parameters


def _columns(vertices: NDArray[Any], columns: tuple[str, ...]) -> NDArray[np.float32]:
    if not columns:
        return np.zeros((len(vertices), 0), np.float32)
    with np.errstate(over="ignore"):  # of doubles: infinity is refused
        return np.stack([vertices[c].astype(np.float32) for c in columns], axis=1)
