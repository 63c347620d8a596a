"""SPZ of Niantic, versions 1 to 4: planes of bytes in gzip (1 to 3) or Zstandard (4).

    header     u32 magic, version, splats · u8 SH degree, fractional bits, flags, 0; of version 4 in place of the 0: u8
               streams, u32 offset of their table (u64 packed, u64 unpacked size each), 12 bytes of 0
    positions  int24 of x 2^bits (version 1: float16) · alphas  255 opacity · colours  255 (0.15 f_dc + 1/2)
    scales     16 (log s + 10) · rotations  index of the largest of x y z w << 30, the others as sign and 9 bits of
               511 |c| sqrt 2 (versions 1, 2: x y z as 127.5 c + 127.5, where w >= 0)
    harmonics  128 f + 128, coefficient-major, to 1/2^(bits - 1)

Axes are x right, y up, z back.  Some programs leave those of the PLY, and nothing in the file tells: see `axes`.
"""

import io
import logging
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from clsplat.errors import DataError
from clsplat.formats import zstd
from clsplat.formats.output import written
from clsplat.formats.packing import morton_order
from clsplat.formats.splats import (
    MAX_DEGREE,
    MAX_FILE,
    Parameters,
    Reading,
    SplatFile,
    Writing,
    flip,
    flipped,
    require_moderate,
    require_some,
)
from clsplat.formats.spz_planes import EXTENSIONS, HEADER, MAGIC, MIP, Header, fraction_of, packed, unpacked
from clsplat.formats.weights import log_weights
from clsplat.reading import read_file

LOG = logging.getLogger("clsplat")
HEADER4 = 32  # bytes, of version 4
GZIP_RATIO = 1032  # most bytes that one byte of deflate can stand for
RATIO4 = 1024  # most bytes of positions that one byte of version 4 may stand for, as in Niantic's library
ALIKE = 1 << 27  # bytes of all planes that a file of version 4 of any size may stand for: 0.6 GB in memory
BLOCK = 1 << 16  # bytes at once
LEVEL = 12  # of libdeflate, its best: 3 % fewer bytes than zlib's
GZIP_START = b"\x1f\x8b\x08\0\0\0\0\0\2\xff"  # without a time and a system: the same model gives the same bytes
ADOBE_AXES = 0xADBE0003  # an extension that changes the axes
EXPECTED = "an SPZ file"


def read_spz(path: Path, options: Reading) -> SplatFile:
    """Read an SPZ file.  Raises DataError when it is missing or damaged, or where its axes are not known."""
    data = read_file(path, EXPECTED, limit=MAX_FILE)
    header, parameters = _unpacked_4(path, data) if data[:4] == MAGIC else _unpacked(path, data)
    if header.degree > MAX_DEGREE:
        LOG.warning("%s: dropped the bands of SH degree 4", path)
    if options.axes == "spz":
        flip(parameters)
    if options.axes == "spz" and not options.quiet:
        LOG.info("%s: axes as the format says (up, back); if it stands on its head, `clsplat convert --axes ply`", path)
    return SplatFile(parameters, {}, "mip" if header.flags & MIP else "default")


def write_spz(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write splats, those with finer harmonics first, else along a Morton curve.

    Raises OutputError; DataError where positions are too large.
    """
    require_some(path, splats)
    require_moderate(path, splats, "SPZ")  # one value that is not finite would spoil the harmonics of all
    p = splats.rows(morton_order(splats.parameters["means"])).parameters
    weights = log_weights(p, splats.has_sky)
    fraction = fraction_of(path, p["means"], options.quality == "high")
    planes = packed(path, flipped(p) if options.axes == "spz" else p, weights, fraction, options)
    numbers = (options.spz_version, len(splats), splats.sh_degree, fraction, MIP if splats.mode == "mip" else 0)
    start = MAGIC + struct.pack("<2I3B", *numbers)
    if options.spz_version == 3:
        content = _gzip(start + b"\0" + b"".join(planes))
    else:
        streams = [plane for plane in planes if plane]
        frames = [zstd.compress(plane) for plane in streams]
        table = b"".join(struct.pack("<2Q", len(f), len(s)) for f, s in zip(frames, streams, strict=True))
        content = start + struct.pack("<BI12x", len(streams), HEADER4) + table + b"".join(frames)
        if len(planes[0]) > len(content) * RATIO4 or sum(map(len, planes)) > _most_of_4(len(content)):
            raise DataError(f"{path}: so many equal splats are refused by readers of version 4; use version 3")
    with written(path) as file:
        file.write(content)
    return file.sha256


def _most_of_4(held: int) -> int:
    """Bytes of all planes for which a file of version 4 with so many bytes may stand."""
    return max(held * RATIO4, ALIKE)


def _gzip(data: bytes) -> bytes:
    """Bytes as one member of gzip."""
    import deflate  # here, as only this needs it

    check = struct.pack("<2I", zlib.crc32(data), len(data) & 0xFFFFFFFF)
    return GZIP_START + deflate.deflate_compress(data, LEVEL) + check


def _unpacked(path: Path, data: bytes) -> tuple[Header, Parameters]:
    """Header and parameters of versions 1 to 3."""
    stream = _Gzip(path, data)
    header = Header.of(path, stream.read(HEADER))
    if header.version > 3:
        raise DataError(f"{path}: SPZ of version 4 in gzip; expected Zstandard: export it again")
    _check_size(path, header, sum(header.sizes), len(data) * GZIP_RATIO)

    def read(size: int) -> bytes:
        if len(found := stream.read(size)) < size:
            expected = HEADER + sum(header.sizes)
            raise DataError(f"{path}: ends early: {header.count} splats take {expected} bytes; copy or export it again")
        return found

    parameters = unpacked(header, [read] * len(header.sizes))
    if header.flags & EXTENSIONS:
        _check_extensions(path, stream.read)
    if stream.read(1):
        raise DataError(f"{path}: goes on after {header.count} splats; copy or export it again")
    stream.require_end()
    return header, parameters


class _Gzip:
    """A member of gzip, a part at a time.  Raises DataError where it is damaged."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.file, self.stream = path, io.BytesIO(data), zlib.decompressobj(31)

    def read(self, size: int) -> bytes:
        """Return so many bytes, or fewer at the end."""
        found = bytearray()
        while len(found) < size and not self.stream.eof:
            fed = self.stream.unconsumed_tail or self.file.read(BLOCK)
            try:
                part = self.stream.decompress(fed, size - len(found))
            except zlib.error as error:
                raise DataError(
                    f"{self.path}: {error}; expected {EXPECTED} in gzip: copy or export it again"
                ) from error
            if not fed and not part:
                break
            found += part
        return bytes(found)

    def require_end(self) -> None:
        """Raise DataError where the member, which is read, is not whole, or something follows it."""
        if not self.stream.eof:
            raise DataError(f"{self.path}: ends early, before the checksum of its gzip; copy or export it again")
        if rest := len(self.stream.unused_data) + len(self.file.read()):
            raise DataError(f"{self.path}: goes on for {rest} bytes after its gzip; copy or export it again")


def _unpacked_4(path: Path, data: bytes) -> tuple[Header, Parameters]:
    """Header and parameters of version 4."""
    header = Header.of(path, data)
    if header.version != 4 or len(data) < HEADER4:
        raise DataError(f"{path}: SPZ of version {header.version} without gzip; expected version 4: export it again")
    streams, table = struct.unpack_from("<BI", data, HEADER - 1)
    present = [size for size in header.sizes if size]
    if streams != len(present) or not HEADER4 <= table <= len(data) - 16 * streams:
        raise DataError(
            f"{path}: has {streams} streams, their table at byte {table}; expected {len(present)}, inside of its "
            f"{len(data)} bytes: copy or export it again"
        )
    _check_size(path, header, header.sizes[0], len(data) * RATIO4)
    _check_size(path, header, sum(header.sizes), _most_of_4(len(data)))
    if header.flags & EXTENSIONS:
        _check_extensions(path, io.BytesIO(data[HEADER4:table]).read)
    start, frames = table + 16 * streams, []
    for number, size in enumerate(present):
        held, declared = struct.unpack_from("<2Q", data, table + 16 * number)
        if declared != size or held > len(data) - start:
            raise DataError(
                f"{path}: stream {number} declares {held} bytes for {declared}; expected {size} for {header.count} "
                "splats, inside of the file: copy or export it again"
            )
        frames.append(zstd.Frame(path, data[start : start + held], size))
        start += held
    if start != len(data):
        raise DataError(f"{path}: goes on after its last stream, at byte {start}; copy or export it again")
    return header, unpacked(header, [frame.read for frame in frames])


def _check_size(path: Path, header: Header, size: int, most: int) -> None:
    """Raise DataError where a file cannot hold so many splats, of this size, before any is made."""
    if size > most:
        raise DataError(
            f"{path}: declares {header.count} splats, {size} bytes, more than it can hold ({most}); "
            "the file is truncated or damaged: copy or export it again"
        )


def _check_extensions(path: Path, read: Callable[[int], bytes]) -> None:
    """Raise DataError for a record that changes the axes; others are skipped, as the library does."""
    while len(record := read(8)) == 8:
        kind, length = struct.unpack("<2I", record)
        if kind == ADOBE_AXES:
            raise DataError(f"{path}: has axes of its own, in the record {kind:#x}; expected none: export it without")
        while length and (part := read(min(length, BLOCK))):
            length -= len(part)
