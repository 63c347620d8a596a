"""The PLY layout of the 3DGS reference: written in its order, read by property name in any order.

    x y z nx ny nz f_dc_0..2 f_rest_0..(3(K-1)-1) opacity scale_0..2 rot_0..3    float32, before activation

f_rest is channel-major (all red, all green, all blue); opacity is a logit, scales are logarithms, rot is (w, x, y, z).
Normals are written as zeros.  Where a world filter is not yet part of scales and opacity, `filter_3D` follows, its
standard deviation (Mip-Splatting); where Gaussians move, the columns of their motion (clsplat/formats/splats.py).
Comments hold the numbers that a rasterizer needs, and the mode for viewers: `SplatRenderMode: mip` when a screen filter
reduces opacities to keep their energy, else `default`.
"""

import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote, shorten
from clsplat.core.reading import open_file
from clsplat.formats.packing import open_hashed
from clsplat.formats.splats import (
    FLAT_LOG_SCALE,
    MAX_DEGREE,
    MOTION,
    PARAMETERS,
    Parameters,
    SplatFile,
    find_motion_columns,
    motion_columns,
    reorder_columns,
    require_size,
    sh_coefficients,
)

# The header of a PLY file: comments, and place and properties of its vertices.

ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}  # of bytes, as NumPy writes them
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
    dtype: np.dtype[Any]  # of one row, in the byte order of the file
    start: int  # bytes before its rows


@dataclass(frozen=True)
class PlyHeader:
    """The vertices of a PLY file."""

    format: str  # one of ORDERS
    comments: tuple[str, ...]
    count: int
    dtype: np.dtype[Any]  # of one vertex, in the byte order of the file
    start: int  # bytes before the vertices; of an ascii file those of the header
    lines_before: int  # of an ascii file: lines between header and vertices
    sections: dict[str, Section] = field(default_factory=dict)  # of a binary file: all elements before one with a list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]  # name and NumPy type
    has_list: bool = False


def parse_ply_header(path: Path, data: bytes) -> PlyHeader:
    """Return the header of a PLY file from its first MAX_HEADER bytes, or more; `path` is for messages.

    Elements before the vertices must have no lists; elements after them may.
    Raises DataError when it is not a PLY file, has no vertices, or has vertices with lists.
    """
    end = END.search(data, 0, MAX_HEADER)
    if not re.match(rb"ply[ \t]*\r?\n", data) or end is None:
        raise DataError(
            f"{path}: not a PLY file; expected a header from 'ply' to 'end_header' in its first {MAX_HEADER} bytes: "
            "copy or export it again"
        )
    form = ""
    elements: list[_Element] = []
    comments = []
    for number, line in enumerate(data[: end.start()].decode("utf-8", "replace").split("\n"), start=1):
        match line.split():
            case ["format", name, _] if name in ORDERS and not form:
                form = name
            case ["element", name, count] if COUNT.fullmatch(count):
                elements.append(_Element(name, int(count), []))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].properties.append((name, TYPES[kind]))
            case ["property", "list", _, _, _] if elements and elements[-1].name != "vertex":
                elements[-1].has_list = True
            case ["comment", *_]:
                comments.append(line.strip().removeprefix("comment").lstrip())
            case [] | ["ply"] | ["obj_info", *_]:
                pass
            case _:
                raise DataError(
                    f"{path}: line {number}: cannot read {quote(line.strip())}; expected a PLY header whose vertices "
                    "have single numbers as properties: export it again"
                )
    if not form:
        raise DataError(f"{path}: the PLY header has no 'format ascii 1.0' or 'format binary_…'; export it again")
    return _vertices(path, form, tuple(comments), elements, end.end())


def format_ply_header(comments: Iterable[str], **elements: tuple[int, Iterable[str]]) -> bytes:
    """Return the header of a binary little-endian file.

    elements: by name the number of rows and the properties of each element, such as `float x`, in their order.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {text}" for text in properties)]
    return "\n".join([*lines, "end_header", ""]).encode()


def _vertices(path: Path, form: str, comments: tuple[str, ...], elements: list[_Element], start: int) -> PlyHeader:
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise DataError(
            f"{path}: has no vertices, only {shorten(', '.join(names)) or 'a header'}; expected 'element vertex N'"
        )
    *before, vertex = elements[: names.index("vertex") + 1]
    if lists := [element.name for element in before if element.has_list]:
        raise DataError(
            f"{path}: {quote(lists[0])}, with a list, stands before the vertices; export it with vertices first"
        )
    properties = [name for name, _ in vertex.properties]
    if not properties or len(set(properties)) < len(properties):
        fault = "a property of the vertices is declared twice" if properties else "its vertices have no properties"
        raise DataError(f"{path}: {fault}; export it again")
    dtype = np.dtype([(name, ORDERS[form] + kind) for name, kind in vertex.properties])
    if form == "ascii":
        return PlyHeader(form, comments, vertex.count, dtype, start, sum(element.count for element in before))
    sections = _sections(elements, ORDERS[form], start)
    return PlyHeader(form, comments, vertex.count, dtype, sections["vertex"].start, 0, sections)


def _sections(elements: list[_Element], order: str, start: int) -> dict[str, Section]:
    """Where the elements of a binary file lie, up to one whose size nobody knows; of two with one name the first."""
    sections: dict[str, Section] = {}
    for element in elements:
        if element.has_list:
            break
        names = [f"{i} {name}" for i, (name, _) in enumerate(element.properties)]
        if len({name for name, _ in element.properties}) == len(element.properties):
            names = [name for name, _ in element.properties]
        kinds = [order + kind for _, kind in element.properties]
        dtype = np.dtype(list(zip(names, kinds, strict=True)))
        sections.setdefault(element.name, Section(element.count, dtype, start))
        start += element.count * dtype.itemsize
    return sections


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
    with open_file(path, "a PLY file") as file:
        header = parse_ply_header(path, file.read(MAX_HEADER))
        if header.format == "ascii":
            raise DataError(f"{path}: is an ascii PLY; expected binary_little_endian or big_endian: export it again")
        rendering, size = rendering_of(path, header), header.count * header.dtype.itemsize
        require_size(path, file.seek(0, os.SEEK_END), header.start + size, f"{header.count} splats")
        file.seek(header.start)
        parameters = _read(path, file, header)
    return SplatFile(parameters, rendering, "mip" if "filter_variance" in parameters else render_mode(header))


def write_ply(path: Path, parameters: Parameters, rendering: dict[str, Any]) -> str:
    """Write parameters in the reference's order, and filter_variance where it is given; return the SHA-256 of the file.

    `rendering` becomes a comment in JSON; with `compensate` in it, the file's mode is mip.  Raises OutputError.
    """
    count = len(parameters["means"])
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(parameters["sh_rest"].shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    names += [FILTER] if "filter_variance" in parameters else []
    names += motion_columns(parameters[MOTION].shape[1]) if MOTION in parameters else ()
    with open_hashed(path) as file:
        file.write(
            format_ply_header(rendering_comments(rendering), vertex=(count, (f"float {name}" for name in names)))
        )
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
        reorder_columns(parameters["sh_rest"], rest // 3, 3),
        parameters["logit_opacity"],
        parameters["log_scales"],
        parameters["quats"],
    ]
    blocks += [np.sqrt(parameters["filter_variance"])] if "filter_variance" in parameters else []
    blocks += [parameters[MOTION]] if MOTION in parameters else []
    return np.ascontiguousarray(np.concatenate(blocks, axis=1), "<f4").tobytes()


def rendering_comments(rendering: dict[str, Any]) -> list[str]:
    """Return the comments of a header that say how a model is rendered."""
    mode = "mip" if rendering.get("compensate") else "default"
    return [f"{RENDERING}{json.dumps(rendering, sort_keys=True, allow_nan=False)}", f"{MODE}{mode}"]


def render_mode(header: PlyHeader) -> str:
    """Return `mip` where a comment of any program says so, else `default`."""
    return "mip" if any(MIP.match(text) for text in header.comments) else "default"


def rendering_of(path: Path, header: PlyHeader) -> dict[str, Any]:
    """Return the numbers of our comment; none where there is another.  Raises DataError for an invalid one."""
    text = next((text.removeprefix(RENDERING) for text in header.comments if text.startswith(RENDERING)), "")
    try:
        values = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return {}
    return check_rendering(path, values) if isinstance(values, dict) else {}


def check_rendering(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return what a file says about rendering.  Raises DataError for an invalid number."""
    for name in NUMBERS:
        value = values.get(name)
        if value is not None and (not isinstance(value, int | float) or not 0 <= value < MAX_NUMBER):
            raise DataError(
                f"{path}: its comment says {name} = {quote(value)}; expected a number from 0 to {MAX_NUMBER:g}: "
                "export it again, or correct that line"
            )
    try:
        json.dumps(values, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: its comment holds what no JSON holds ({quote(error)}); export it again, or correct it"
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
    parameters["sh_rest"] = reorder_columns(by_channel, 3, per_channel)
    if parameters["log_scales"].shape[1] == 2:
        parameters["log_scales"] = np.pad(parameters["log_scales"], ((0, 0), (0, 1)), constant_values=FLAT_LOG_SCALE)
    parameters = {name: parameters[name] for name in PARAMETERS}
    if FILTER in names:
        with np.errstate(over="ignore"):  # infinity is refused
            parameters["filter_variance"] = np.square(_columns(vertices, (FILTER,)))
    moving = find_motion_columns(names)
    if moving is None:
        raise DataError(
            f"{path}: has some properties of a motion and lacks others; expected velocity_0..2, time_center and "
            "log_duration, and none or all of acceleration_0..2, jerk_0..2 and turn_0..3: export it again"
        )
    return {**parameters, MOTION: _columns(vertices, moving)} if moving else parameters


def _columns(vertices: NDArray[Any], columns: tuple[str, ...]) -> NDArray[np.float32]:
    if not columns:
        return np.zeros((len(vertices), 0), np.float32)
    with np.errstate(over="ignore"):  # of doubles: infinity is refused
        return np.stack([vertices[c].astype(np.float32) for c in columns], axis=1)


# Several splat PLY files as one, a piece at a time: the memory is that of a piece, whatever the files hold.

PIECE_ROWS = 1 << 16  # of a piece
Check = Callable[[int, NDArray[np.float32]], None]


def join_plys(path: Path, parts: Sequence[Path], check: Check) -> int:
    """Write the vertices of all parts, in their order, with the header of the first; return their number.

    check: is given the number of a part and the means of some of its rows, [n, 3], and raises what is wrong.
    Raises DataError where a part is damaged or has other properties or another comment than the first, OutputError.
    """
    headers = [_header(part) for part in parts]
    first, count = headers[0], sum(header.count for header in headers)
    for part, header in zip(parts, headers, strict=True):
        if (header.dtype, header.comments) != (first.dtype, first.comments):
            raise DataError(f"{part}: has other properties, or another comment, than {parts[0]}; train both alike")
    properties = [f"float {name}" for name in first.dtype.names or ()]
    with open_hashed(path) as output:
        output.write(format_ply_header(first.comments, vertex=(count, properties)))
        for number, (part, header) in enumerate(zip(parts, headers, strict=True)):
            with open_file(part, "a PLY file") as file:
                file.seek(header.start)
                for start in range(0, header.count, PIECE_ROWS):
                    size = min(PIECE_ROWS, header.count - start) * header.dtype.itemsize
                    piece = file.read(size)
                    if len(piece) < size:
                        raise DataError(f"{part}: its end is missing; train that block again")
                    rows = np.frombuffer(piece, header.dtype)
                    check(number, np.stack([rows[axis].astype(np.float32) for axis in "xyz"], axis=1))
                    output.write(piece)
    return count


def _header(part: Path) -> PlyHeader:
    with open_file(part, "a PLY file") as file:
        header = parse_ply_header(part, file.read(MAX_HEADER))
    kinds = {header.dtype[name] for name in header.dtype.names or ()}
    if header.format != "binary_little_endian" or list(header.sections) != ["vertex"] or kinds != {np.dtype("<f4")}:
        raise DataError(f"{part}: expected a model as `export` writes it")
    return header
