"""The header of a PLY file: comments, and place and properties of its vertices."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
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
                    f"{path}: line {number}: cannot read {quoted(line.strip())}; expected a PLY header whose vertices "
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
