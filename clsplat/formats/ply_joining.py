"""Several splat PLY files as one, a piece at a time: the memory is that of a piece, whatever the files hold."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.formats.output import written
from clsplat.ply_header import MAX_HEADER, PlyHeader, format_ply_header, parse_ply_header
from clsplat.reading import opened

ROWS = 1 << 16  # of a piece
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
    with written(path) as output:
        output.write(format_ply_header(first.comments, vertex=(count, properties)))
        for number, (part, header) in enumerate(zip(parts, headers, strict=True)):
            with opened(part, "a PLY file") as file:
                file.seek(header.start)
                for start in range(0, header.count, ROWS):
                    size = min(ROWS, header.count - start) * header.dtype.itemsize
                    piece = file.read(size)
                    if len(piece) < size:
                        raise DataError(f"{part}: its end is missing; train that block again")
                    rows = np.frombuffer(piece, header.dtype)
                    check(number, np.stack([rows[axis].astype(np.float32) for axis in "xyz"], axis=1))
                    output.write(piece)
    return count


def _header(part: Path) -> PlyHeader:
    with opened(part, "a PLY file") as file:
        header = parse_ply_header(part, file.read(MAX_HEADER))
    kinds = {header.dtype[name] for name in header.dtype.names or ()}
    if header.format != "binary_little_endian" or list(header.sections) != ["vertex"] or kinds != {np.dtype("<f4")}:
        raise DataError(f"{part}: expected a model as `export` writes it")
    return header
