"""Read and write the PLY files of 3DGS.  Properties are written in the order of 3DGS, and read in any order.

    x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3    float32, before activation

f_rest is channel-major (all red, all green, all blue); opacity is a logit, scales are logarithms, rot is (w, x, y, z).
Normals are written as zeros.  `filter_3D`, the standard deviation of a world filter (Mip-Splatting), follows if the
filter is not baked into scales and opacity.  For moving Gaussians, the columns of their motion follow
(clsplat/formats/splats.py).  Comments contain the rendering settings, and the mode for viewers: `SplatRenderMode: mip`
if a screen filter reduces opacities to conserve energy, else `default`.
"""

import io
import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote, shorten
from clsplat.core.reading import open_file, require_content
from clsplat.formats.packing import open_hashed
from clsplat.formats.splats import (
    FLAT_LOG_SCALE,
    FLATNESS,
    MAX_DEGREE,
    MAX_STORED_DEGREE,
    MOTION,
    PARAMETERS,
    Parameters,
    SplatFile,
    find_motion_columns,
    motion_columns,
    reorder_columns,
    require_memory,
    require_size,
    sh_coefficients,
    warn_dropped,
)

# The header of a PLY file: comments, and position and properties of its vertices.

ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}  # byte orders in NumPy's notation
MAX_HEADER = 1 << 16  # bytes; real headers have about 1.5 KB
END = re.compile(rb"\nend_header[ \t]*\r?\n")
COUNT = re.compile("[0-9]{1,18}")
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True)
class Section:
    """One element of a binary PLY file."""

    count: int
    dtype: np.dtype[Any]  # type of one row, in the byte order of the file
    start: int  # offset of its rows, bytes


@dataclass(frozen=True)
class PlyHeader:
    """The parsed header of a PLY file, with the layout of its vertices."""

    format: str  # one of ORDERS
    comments: tuple[str, ...]
    count: int
    dtype: np.dtype[Any]  # type of one vertex, in the byte order of the file
    start: int  # offset of the vertices, bytes; in an ascii file, size of the header
    lines_before: int  # number of lines between header and vertices of an ascii file
    sections: dict[str, Section] = field(default_factory=dict)  # elements of a binary file before the first list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]  # name and NumPy type
    has_list: bool = False


def parse_ply_header(path: Path, data: bytes) -> PlyHeader:
    """Parse the header of a PLY file from at least its first MAX_HEADER bytes; `path` is for messages.

    Elements before the vertices must not have lists; elements after them may.
    Raises DataError if the file is not a PLY file, has no vertices, or has vertices with lists.
    """
    end = END.search(data, 0, MAX_HEADER)
    if not re.match(rb"ply[ \t]*\r?\n", data) or end is None:
        require_content(path, data)
        raise DataError(
            f"{path}: not a PLY file; expected a header from 'ply' to 'end_header' in its first {MAX_HEADER} bytes; "
            "copy or export it again"
        )
    encoding = ""
    elements: list[_Element] = []
    comments = []
    for number, line in enumerate(data[: end.start()].decode("utf-8", "replace").split("\n"), start=1):
        match line.split():
            case ["format", name, _] if name in ORDERS and not encoding:
                encoding = name
            case ["element", name, count] if COUNT.fullmatch(count):
                elements.append(_Element(name, int(count), []))
            case ["property", type_name, name] if type_name in TYPES and elements:
                elements[-1].properties.append((name, TYPES[type_name]))
            case ["property", "list", _, _, _] if elements and elements[-1].name != "vertex":
                elements[-1].has_list = True
            case ["comment", *_]:
                comments.append(line.strip().removeprefix("comment").lstrip())
            case [] | ["ply"] | ["obj_info", *_]:
                pass
            case _:
                raise DataError(
                    f"{path}: line {number}: cannot read {quote(line.strip())}; expected a PLY header whose vertex "
                    "properties are scalars: export it again"
                )
    if not encoding:
        raise DataError(f"{path}: the PLY header has no 'format ascii 1.0' or 'format binary_…'; export it again")
    return _make_header(path, encoding, tuple(comments), elements, end.end())


def read_ascii(path: Path, data: bytes, header: PlyHeader) -> NDArray[Any]:
    """Return the vertices of an ASCII file, one per line, as a structured array, [count].  Raises DataError."""
    body = io.BytesIO(data[header.start :])
    for _ in range(header.lines_before):
        if not body.readline():
            break
    # Each number needs a digit and a space, but the last space may be missing.
    size = header.start + body.tell() + 2 * len(header.dtype.names or ()) * header.count
    require_size(path, len(data) + 1, size, f"{header.count} vertices")
    if header.count == 0:
        return np.empty(0, header.dtype)
    lines = islice((line for line in body if not line.isspace()), header.count)
    try:
        table = np.loadtxt(lines, header.dtype, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        raise DataError(
            f"{path}: after the header: {shorten(str(error).partition(';')[0].rstrip('.'), 200)}; expected one "
            "number for each property: export it again"
        ) from error
    if len(table) < header.count:
        raise DataError(
            f"{path}: expected {header.count} lines of vertices, found {len(table)}; the file is truncated: "
            "copy or export it again"
        )
    return table


def format_ply_header(comments: Iterable[str], **elements: tuple[int, Iterable[str]]) -> bytes:
    """Return the header of a binary little-endian file.

    elements: the number of rows and the properties, such as `float x`, of each element, by name.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {text}" for text in properties)]
    return "\n".join([*lines, "end_header", ""]).encode()


def _make_header(
    path: Path, encoding: str, comments: tuple[str, ...], elements: list[_Element], start: int
) -> PlyHeader:
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise DataError(
            f"{path}: has no vertices, only {shorten(', '.join(names)) or 'a header'}; expected 'element vertex N'; "
            "export it again"
        )
    *preceding_elements, vertex = elements[: names.index("vertex") + 1]
    if lists := [element.name for element in preceding_elements if element.has_list]:
        raise DataError(
            f"{path}: the element {quote(lists[0])} has a list and precedes the vertices; export it with vertices first"
        )
    properties = [name for name, _ in vertex.properties]
    if not properties or len(set(properties)) < len(properties):
        fault = "a property of the vertices is declared twice" if properties else "its vertices have no properties"
        raise DataError(f"{path}: {fault}; export it again")
    dtype = np.dtype([(name, ORDERS[encoding] + type_) for name, type_ in vertex.properties])
    if encoding == "ascii":
        lines_before = sum(element.count for element in preceding_elements)
        return PlyHeader(encoding, comments, vertex.count, dtype, start, lines_before)
    sections = _list_sections(elements, ORDERS[encoding], start)
    return PlyHeader(encoding, comments, vertex.count, dtype, sections["vertex"].start, 0, sections)


def _list_sections(elements: list[_Element], order: str, start: int) -> dict[str, Section]:
    """Return a binary file's sections before the first list, by name; if a name is repeated, the first such section."""
    sections: dict[str, Section] = {}
    for element in elements:
        if element.has_list:
            break
        names = [f"{i} {name}" for i, (name, _) in enumerate(element.properties)]
        if len({name for name, _ in element.properties}) == len(element.properties):
            names = [name for name, _ in element.properties]
        types = [order + type_ for _, type_ in element.properties]
        dtype = np.dtype(list(zip(names, types, strict=True)))
        sections.setdefault(element.name, Section(element.count, dtype, start))
        start += element.count * dtype.itemsize
    return sections


RENDERING, MODE = "clsplat ", "SplatRenderMode: "  # starts of comments
# comments with which several programs mark a mip model
MIP = re.compile(r"SplatRenderMode\s*:\s*mip|postshot\.anti_aliasing\s*=\s*1", re.IGNORECASE)
FILTER = "filter_3D"
NUMERIC_SETTINGS = ("near", "screen_variance", "compensate", "pixel_box")  # rendering settings with values from 0
ROWS = 65_536  # rows in memory at once while reading and writing
MAX_NUMBER = 1e15  # same limit as for numbers in a dataset
_COLUMNS = {
    "means": ("x", "y", "z"),
    "sh_base": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacity": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}


def read_ply(path: Path) -> SplatFile:
    """Read a splat PLY.  The discs of 2DGS, which have no scale_2, get a third log scale of at most FLAT_LOG_SCALE.

    Raises DataError if the file is missing, damaged, or not a splat PLY.
    """
    with open_file(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        degree = _find_degree(path, header.dtype.names or ())
        warn_dropped(path, degree)
        rendering, size = read_rendering_comment(path, header), header.count * header.dtype.itemsize
        if header.format == "ascii":
            file.seek(0)
            parameters = _to_parameters(path, read_ascii(path, file.read(), header))
        else:
            require_size(path, file.seek(0, os.SEEK_END), header.start + size, f"{header.count} splats")
            require_memory(path, header.count, degree)
            file.seek(header.start)
            parameters = _read_binary(path, file, header)
    return SplatFile(parameters, rendering, "mip" if "filter_variance" in parameters else render_mode(header))


def write_ply(path: Path, parameters: Parameters, rendering: dict[str, Any]) -> str:
    """Write parameters in the property order of 3DGS, and filter_variance if present; return the file's SHA-256.

    `rendering` becomes a JSON comment; if its `compensate` is true, the mode is mip.  Raises OutputError.
    """
    count = len(parameters["means"])
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(parameters["sh_rest"].shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    names += [FILTER] if "filter_variance" in parameters else []
    names += motion_columns(parameters[MOTION].shape[1]) if MOTION in parameters else ()
    types = dict.fromkeys("xyz", "double") if parameters["means"].dtype == np.float64 else {}
    properties = [f"{types.get(name, 'float')} {name}" for name in names]
    with open_hashed(path) as file:
        file.write(format_ply_header(rendering_comments(rendering), vertex=(count, properties)))
        for first in range(0, count, ROWS):
            file.write(_encode_rows({name: table[first : first + ROWS] for name, table in parameters.items()}))
    return file.sha256


def _encode_rows(parameters: Parameters) -> bytes:
    """Encode parameters as the rows of a file."""
    count, rest_columns = parameters["sh_rest"].shape
    means = parameters["means"]
    blocks = [
        means.astype("<f8").view("<f4") if means.dtype == np.float64 else means,  # a double takes two columns
        np.zeros((count, 3), np.float32),
        parameters["sh_base"],
        reorder_columns(parameters["sh_rest"], rest_columns // 3, 3),
        parameters["logit_opacity"],
        parameters["log_scales"],
        parameters["quats"],
    ]
    blocks += [np.sqrt(parameters["filter_variance"])] if "filter_variance" in parameters else []
    blocks += [parameters[MOTION]] if MOTION in parameters else []
    return np.ascontiguousarray(np.concatenate(blocks, axis=1), "<f4").tobytes()


def rendering_comments(rendering: dict[str, Any]) -> list[str]:
    """Return the header comments that contain the rendering settings."""
    mode = "mip" if rendering.get("compensate") else "default"
    return [f"{RENDERING}{json.dumps(rendering, sort_keys=True, allow_nan=False)}", f"{MODE}{mode}"]


def render_mode(header: PlyHeader) -> str:
    """Return `mip` if a comment of a known program marks the model as mip, else `default`."""
    return "mip" if any(MIP.match(text) for text in header.comments) else "default"


def read_rendering_comment(path: Path, header: PlyHeader) -> dict[str, Any]:
    """Return the rendering settings in clsplat's JSON comment, or {}.  Raises DataError for an invalid value."""
    text = next((text.removeprefix(RENDERING) for text in header.comments if text.startswith(RENDERING)), "")
    try:
        values = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return {}
    return check_rendering(path, values) if isinstance(values, dict) else {}


def read_extras(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """Return clsplat's rendering settings in the extras of a JSON object, or {}.  Raises DataError if invalid."""
    extras = table.get("extras")
    values = extras.get("clsplat") if isinstance(extras, dict) else None
    return check_rendering(path, values) if isinstance(values, dict) else {}


def check_rendering(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Validate the rendering settings of a file and return them.  Raises DataError for an invalid value."""
    for name in NUMERIC_SETTINGS:
        value = values.get(name)
        if value is not None and (not isinstance(value, int | float) or not 0 <= value < MAX_NUMBER):
            raise DataError(
                f"{path}: its comment says {name} = {quote(value)}; expected a number from 0 to {MAX_NUMBER:g}; "
                "export it again, or correct that line"
            )
    origin = values.get("origin", [0, 0, 0])
    is_list = isinstance(origin, list) and len(origin) == 3
    if not is_list or not all(isinstance(value, int | float) and abs(value) < MAX_NUMBER for value in origin):
        raise DataError(f"{path}: its comment has the origin {quote(origin)}; expected 3 numbers: export it again")
    try:
        json.dumps(values, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: its comment is not valid JSON ({quote(error)}); export it again, or correct it"
        ) from error
    return values


def _read_binary(path: Path, file: BinaryIO, header: PlyHeader) -> Parameters:
    """Read the parameters from a file that is positioned at its first row, in blocks of rows."""
    tables: Parameters = {}
    for first in range(0, max(header.count, 1), ROWS):
        rows = min(ROWS, header.count - first)
        block = _to_parameters(path, np.frombuffer(file.read(rows * header.dtype.itemsize), header.dtype))
        if not tables:
            tables = {name: np.empty((header.count, table.shape[1]), table.dtype) for name, table in block.items()}
        for name, table in block.items():
            tables[name][first : first + rows] = table
    return tables


def _find_degree(path: Path, names: Sequence[str]) -> int:
    """Return the SH degree from the property names.  Raises DataError."""
    count = sum(name.startswith("f_rest_") for name in names)
    degree = next((d for d in range(MAX_STORED_DEGREE + 1) if 3 * (sh_coefficients(d) - 1) == count), None)
    if degree is None or not {f"f_rest_{i}" for i in range(count)} <= set(names):
        raise DataError(
            f"{path}: has {count} f_rest properties; expected 0, 9, 24, 45, or 72, numbered from 0; export it again"
        )
    return degree


def _to_parameters(path: Path, vertices: NDArray[Any]) -> Parameters:
    names = vertices.dtype.names or ()
    columns_by_name = dict(_COLUMNS)
    if is_flat := "scale_1" in names and "scale_2" not in names:  # 2DGS
        columns_by_name["log_scales"] = ("scale_0", "scale_1")
    missing_columns = [column for columns in columns_by_name.values() for column in columns if column not in names]
    if missing_columns:
        raise DataError(
            f"{path}: not a splat file: it has no {', '.join(missing_columns[:4])}"
            f"{' …' if len(missing_columns) > 4 else ''}; to train from a point cloud, use `clsplat run`"
        )
    rest_columns = tuple(f"f_rest_{i}" for i in range(3 * (sh_coefficients(_find_degree(path, names)) - 1)))
    parameters = {name: _stack_columns(vertices, columns) for name, columns in columns_by_name.items()}
    if vertices.dtype["x"].itemsize == 8:  # may be world coordinates, for which float32 is too coarse
        exact_means = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=1)
        parameters["means"] = np.where(np.isfinite(parameters["means"]), exact_means, parameters["means"])
    rest = reorder_columns(_stack_columns(vertices, rest_columns), 3, len(rest_columns) // 3)
    parameters["sh_rest"] = np.ascontiguousarray(rest[:, : 3 * (sh_coefficients(MAX_DEGREE) - 1)])
    if is_flat:
        flat_scale = np.minimum(parameters["log_scales"].min(axis=1, keepdims=True) + FLATNESS, FLAT_LOG_SCALE)
        parameters["log_scales"] = np.hstack([parameters["log_scales"], flat_scale]).astype(np.float32)
    parameters = {name: parameters[name] for name in PARAMETERS}
    if FILTER in names:
        with np.errstate(over="ignore"):  # infinity is rejected later
            parameters["filter_variance"] = np.square(_stack_columns(vertices, (FILTER,)))
    motion = find_motion_columns(names)
    if motion is None:
        raise DataError(
            f"{path}: has only some of the motion properties; expected velocity_0..2, time_center, and log_duration, "
            "and none or all of acceleration_0..2, jerk_0..2, and turn_0..3; export it again"
        )
    return {**parameters, MOTION: _stack_columns(vertices, motion)} if motion else parameters


def _stack_columns(vertices: NDArray[Any], columns: tuple[str, ...]) -> NDArray[np.float32]:
    if not columns:
        return np.zeros((len(vertices), 0), np.float32)
    with np.errstate(over="ignore"):  # large doubles become infinity, which is rejected later
        return np.stack([vertices[c].astype(np.float32) for c in columns], axis=1)


# Joining PLY files block by block, with little memory.

Check = Callable[[int, NDArray[np.float32]], None]


def join_plys(path: Path, parts: Sequence[Path], check: Check) -> int:
    """Write the vertices of all parts in order, with the header of the first part; return the number of vertices.

    check: called with the index of a part and the means of some of its rows, [n, 3]; it may raise an error.
    Raises DataError if a part is damaged, or differs from the first in properties or comments, and OutputError.
    """
    headers = [_read_header(part) for part in parts]
    first, count = headers[0], sum(header.count for header in headers)
    for part, header in zip(parts, headers, strict=True):
        if (header.dtype, header.comments) != (first.dtype, first.comments):
            raise DataError(
                f"{part}: differs from {parts[0]} in properties or comments; train both with the same settings"
            )
    properties = [f"float {name}" for name in first.dtype.names or ()]
    with open_hashed(path) as output:
        output.write(format_ply_header(first.comments, vertex=(count, properties)))
        for index, (part, header) in enumerate(zip(parts, headers, strict=True)):
            with open_file(part, "a PLY file") as file:
                file.seek(header.start)
                for start in range(0, header.count, ROWS):
                    size = min(ROWS, header.count - start) * header.dtype.itemsize
                    block = file.read(size)
                    if len(block) < size:
                        raise DataError(f"{part}: is truncated; train that block again")
                    rows = np.frombuffer(block, header.dtype)
                    check(index, np.stack([rows[axis].astype(np.float32) for axis in "xyz"], axis=1))
                    output.write(block)
    return count


def _read_header(part: Path) -> PlyHeader:
    with open_file(part, "a PLY file") as file:
        header = parse_ply_header(part, file.read(MAX_HEADER))
    dtypes = {header.dtype[name] for name in header.dtype.names or ()}
    if header.format != "binary_little_endian" or list(header.sections) != ["vertex"] or dtypes != {np.dtype("<f4")}:
        raise DataError(f"{part}: expected the PLY that the block's run wrote; train that block again")
    return header
