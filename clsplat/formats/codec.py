"""What the table of formats holds for each: words, and functions that tell, read and write it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import DataError
from clsplat.formats.splats import Reading, SplatFile, Writing
from clsplat.ply_header import PlyHeader, parse_ply_header


@dataclass(frozen=True)
class Start:
    """How a file begins."""

    path: Path
    data: bytes  # at most MAX_HEADER
    size: int  # bytes of the file

    def ply(self) -> PlyHeader | None:
        """The header, where it is a PLY file that can be read."""
        if not self.data.startswith(b"ply"):
            return None
        try:
            return parse_ply_header(self.path, self.data)
        except DataError:  # its reader says what is wrong
            return None


@dataclass(frozen=True)
class Codec:
    """One format."""

    name: str
    endings: tuple[str, ...]  # of names of files; the first is the usual one
    reads: str  # in words; "" where there is no reader
    writes: str  # in words; "" where there is no writer, "by …" where a command alone writes it
    loses: str  # in words: what writing changes
    is_one: Callable[[Start], bool] = lambda start: False
    read: Callable[[Path, Reading], SplatFile] | None = None
    write: Callable[[Path, SplatFile, Writing], str] | None = None  # returns the SHA-256 of the file
    keeps_filter: bool = False  # filter_3D
    keeps_motion: bool = False
    keeps_mode: bool = True  # the mark of a mip model
    keeps_numbers: bool = False  # of the rasterizer
    keeps_nan: bool = False
    has_quality: bool = False  # writing heeds Writing.quality
    has_axes: bool = False  # reading and writing heed axes, of which nothing in the file tells
    has_bits: bool = False  # writing heeds Writing.sh_bits and Writing.spz_version
