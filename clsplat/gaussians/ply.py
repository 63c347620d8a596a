"""The PLY layout of the 3DGS reference: written in its order, read by property name in any order.

    x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3    float32, before activation

f_rest is channel-major (all red, all green, all blue); opacity is a logit, scales are logarithms, rot is (w, x, y, z).
Normals are written as zeros.  Where a world filter is not yet part of scales and opacity, `filter_3D` follows, its
standard deviation (Mip-Splatting).  Comments hold the numbers that a rasterizer needs, and the mode for viewers:
`SplatRenderMode: mip` when a screen filter reduces opacities to keep their energy, else `default`.
"""

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted
from clsplat.files import atomic
from clsplat.gaussians.tables import PARAMETERS, sh_coefficients
from clsplat.ply_header import MAX_HEADER, PlyHeader, parse_ply_header
from clsplat.reading import opened

RENDERING, MODE = "clsplat ", "SplatRenderMode: "  # comments
FILTER = "filter_3D"
NUMBERS = ("near", "screen_variance", "compensate")  # of the comment
MAX_NUMBER = 1e15  # as of any number in a dataset
MAX_DEGREE = 3
_COLUMNS = {
    "means": ("x", "y", "z"),
    "sh_base": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacity": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}

Parameters = dict[str, NDArray[np.float32]]  # by the names of PARAMETERS, each [N, components]


@dataclass(frozen=True)
class SplatFile:
    """A model file: the parameters, and the numbers of its comment for rendering them."""

    parameters: Parameters  # filter_variance too, where the file has it
    rendering: dict[str, Any] = field(default_factory=dict)
    mode: str = "default"  # SplatRenderMode


def is_splat(path: Path) -> bool:
    """Return whether the header of a PLY file declares splats.  Raises DataError when it is missing or no PLY."""
    with opened(path, "a PLY file") as file:
        return "f_dc_0" in (parse_ply_header(path, file.read(MAX_HEADER)).dtype.names or ())


def read_ply(path: Path) -> SplatFile:
    """Read a splat PLY.  Raises DataError when it is missing, damaged or not a splat."""
    with opened(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        if header.format == "ascii":
            raise DataError(f"{path}: is an ascii PLY; expected binary_little_endian or big_endian: export it again")
        rendering, size = _rendering(path, header), header.count * header.dtype.itemsize
        held, expected = file.seek(0, os.SEEK_END), header.start + size
        if held < expected:
            raise DataError(
                f"{path}: holds {held} bytes, but its header declares {header.count} splats, {expected} bytes; "
                "the file is truncated: copy or export it again"
            )
        file.seek(header.start)
        parameters = _parameters(path, np.frombuffer(file.read(size), header.dtype))
    mode = "mip" if "filter_variance" in parameters else _comment(header, MODE) or "default"
    return SplatFile(parameters, rendering, mode)


def write_ply(path: Path, parameters: Parameters, rendering: dict[str, Any]) -> str:
    """Write parameters in the reference's order, and filter_variance where it is given; return the SHA-256 of the file.

    `rendering` becomes a comment in JSON; with `compensate` in it, the file's mode is mip.  Raises OutputError.
    """
    count = len(parameters["means"])
    coefficients = 1 + parameters["sh_rest"].shape[1] // 3
    rest = _swapped(parameters["sh_rest"], coefficients - 1, 3)
    blocks = [
        parameters["means"],
        np.zeros((count, 3), np.float32),
        parameters["sh_base"],
        rest,
        parameters["logit_opacity"],
        parameters["log_scales"],
        parameters["quats"],
    ]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest.shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    if "filter_variance" in parameters:
        blocks.append(np.sqrt(parameters["filter_variance"]))
        names.append(FILTER)
    mode = "mip" if rendering.get("compensate") else "default"
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {RENDERING}{json.dumps(rendering, sort_keys=True)}",
        f"comment {MODE}{mode}",
    ]
    header += [f"element vertex {count}", *(f"property float {name}" for name in names), "end_header"]
    body = np.ascontiguousarray(np.concatenate(blocks, axis=1), "<f4")
    written = hashlib.sha256()
    with atomic(path) as file:
        for part in (("\n".join(header) + "\n").encode(), body.tobytes()):
            file.write(part)
            written.update(part)
    return written.hexdigest()


def _comment(header: PlyHeader, start: str) -> str:
    """The text after `start` in the first comment that begins with it, or ""."""
    return next((text.removeprefix(start).strip() for text in header.comments if text.startswith(start)), "")


def _rendering(path: Path, header: PlyHeader) -> dict[str, Any]:
    """The numbers of the comment; none where a comment says something else.  Raises DataError for an invalid one."""
    try:
        values = json.loads(_comment(header, RENDERING) or "{}")
    except (ValueError, RecursionError):
        return {}
    if not isinstance(values, dict):
        return {}
    for name in NUMBERS:
        value = values.get(name)
        if value is not None and (not isinstance(value, int | float) or not 0 <= value < MAX_NUMBER):
            raise DataError(
                f"{path}: its comment says {name} = {quoted(value)}; expected a number from 0 to {MAX_NUMBER:g}: "
                "export it again, or correct that line"
            )
    return values


def _parameters(path: Path, vertices: NDArray[Any]) -> Parameters:
    names = vertices.dtype.names or ()
    missing = [column for columns in _COLUMNS.values() for column in columns if column not in names]
    if missing:
        raise DataError(
            f"{path}: not a splat file: it has no {', '.join(missing[:4])}{' …' if len(missing) > 4 else ''}; "
            "train from a point cloud with `clsplat run`, or decompress the file first"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    degree = next((d for d in range(MAX_DEGREE + 1) if 3 * (sh_coefficients(d) - 1) == rest), None)
    columns = tuple(f"f_rest_{i}" for i in range(rest))
    if degree is None or not set(columns) <= set(names):
        raise DataError(f"{path}: has {rest} f_rest properties; expected 0, 9, 24 or 45, numbered from 0 on")
    parameters = {name: _columns(vertices, columns) for name, columns in _COLUMNS.items()}
    by_channel = _columns(vertices, columns)
    per_channel = sh_coefficients(degree) - 1
    parameters["sh_rest"] = _swapped(by_channel, 3, per_channel)
    parameters = {name: parameters[name] for name in PARAMETERS}
    if FILTER in names:
        with np.errstate(over="ignore"):  # infinity is refused
            parameters["filter_variance"] = np.square(_columns(vertices, (FILTER,)))
    bad = [name for name, table in parameters.items() if not np.isfinite(table).all()]
    if bad:
        raise DataError(f"{path}: {', '.join(bad)} hold values that are not finite; export the file again")
    return parameters


def _swapped(table: NDArray[np.float32], outer: int, inner: int) -> NDArray[np.float32]:
    """Columns in outer-major order -> inner-major, [N, outer * inner]."""
    count = len(table)
    swapped = table.reshape(count, outer, inner).transpose(0, 2, 1)
    return np.ascontiguousarray(swapped.reshape(count, outer * inner))


def _columns(vertices: NDArray[Any], columns: tuple[str, ...]) -> NDArray[np.float32]:
    if not columns:
        return np.zeros((len(vertices), 0), np.float32)
    with np.errstate(over="ignore"):  # of doubles: infinity is refused
        return np.stack([vertices[c].astype(np.float32) for c in columns], axis=1)
