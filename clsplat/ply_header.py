"""Read the header of a PLY file: comments, and place and properties of its vertices."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import DataError, quoted, shortened

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
class PlyHeader:
    """The vertices of a PLY file."""

    format: str  # one of ORDERS
    comments: tuple[str, ...]
    count: int
    dtype: np.dtype[Any]  # of one vertex, in the byte order of the file
    start: int  # bytes before the vertices; of an ascii file those of the header
    lines_before: int  # of an ascii file: lines between header and vertices


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
                    f"{path}: line {number}: cannot read {quoted(line.strip())}; expected a PLY header whose vertices "
                    "have single numbers as properties: export it again"
                )
    if not form:
        raise DataError(f"{path}: the PLY header has no 'format ascii 1.0' or 'format binary_…'; export it again")
    return _vertices(path, form, tuple(comments), elements, end.end())


def _vertices(path: Path, form: str, comments: tuple[str, ...], elements: list[_Element], start: int) -> PlyHeader:
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise DataError(
            f"{path}: has no vertices, only {shortened(', '.join(names)) or 'a header'}; expected 'element vertex N'"
        )
    *before, vertex = elements[: names.index("vertex") + 1]
    if lists := [element.name for element in before if element.has_list]:
        raise DataError(
            f"{path}: {quoted(lists[0])}, with a list, stands before the vertices; export it with vertices first"
        )
    properties = [name for name, _ in vertex.properties]
    if not properties or len(set(properties)) < len(properties):
        fault = "a property of the vertices is declared twice" if properties else "its vertices have no properties"
        raise DataError(f"{path}: {fault}; export it again")
    dtype = np.dtype([(name, ORDERS[form] + kind) for name, kind in vertex.properties])
    if form == "ascii":
        return PlyHeader(form, comments, vertex.count, dtype, start, sum(element.count for element in before))
    sizes = [element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties) for element in before]
    return PlyHeader(form, comments, vertex.count, dtype, start + sum(sizes), 0)
