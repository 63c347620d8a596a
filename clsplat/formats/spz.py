"""SPZ of Niantic, versions 1 to 4: planes of bytes in gzip (1 to 3) or Zstandard (4).

    header     u32 magic, version, splats · u8 SH degree, fractional bits, flags, 0; of version 4 in place of the 0: u8
               streams, u32 offset of their table (u64 packed, u64 unpacked size each), 12 bytes of 0
    positions  int24 of x 2^bits (version 1: float16) · alphas  255 opacity · colors  255 (0.15 f_dc + 1/2)
    scales     16 (log s + 10) · rotations  index of the largest of x y z w << 30, the others as sign and 9 bits of
               511 |c| sqrt 2 (versions 1, 2: x y z as 127.5 c + 127.5, where w >= 0)
    harmonics  128 f + 128, coefficient-major, to 1/2^(bits - 1)

Axes are x right, y up, z back.  Some programs leave those of the PLY, and nothing in the file tells: see `axes`.
"""

import io
import logging
import math
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.reading import read_file
from clsplat.formats.packing import (
    from_smallest_three,
    morton_order,
    outside_bytes,
    smallest_three,
    warn_clipped,
    write_bytes,
)
from clsplat.formats.sog_quantize import (
    compensate_base,
    log_weights,
    quantization_steps,
    round_sh,
    usual_step,
    visible_form,
)
from clsplat.formats.splats import (
    MAX_DEGREE,
    MAX_FILE,
    PARAMETERS,
    Parameters,
    Reading,
    SplatFile,
    Writing,
    flip_axes,
    flip_axes_in_place,
    logits,
    opacities,
    require_gaussians,
    require_in_range,
    sh_coefficients,
    unit,
)

# The planes of an SPZ file: numbers as bytes, and bytes as numbers.

LOG = logging.getLogger("clsplat")
MAGIC = b"NGSP"
MIP, EXTENSIONS = 1, 2  # flags
HEADER = 16  # bytes
STORED_DEGREE = 4  # which the format knows; bands beyond MAX_DEGREE are dropped
COLOR = 0.15
MAX_INT24 = 2**23 - 1
FRACTION, FINE_FRACTION = 12, 20  # bits of positions; the second for quality high
ROWS = 1 << 13  # that are decoded at once: what that takes beside the result is little
WHOLE = (8, 8)  # bits of harmonics
# steps of harmonics, in levels of 256: of the Gaussian of median weight, for the usual size and at most; of any one
MEDIAN_STEP = {"small": (7.5, 12.5), "balanced": (3.0, 5.0), "high": (1.0, 1.0)}
LARGEST_STEP = {"small": 128.0, "balanced": 64.0, "high": 1.0}
# step of positions: a share of the smallest deviation, for a Gaussian of median weight
SMALLEST_SHARE = {"small": 0.5, "balanced": 0.5, "high": 0.0}
# steps of colors, in levels of 255: of the Gaussian of median weight, and at most
BASE_STEP = {"small": (2**0.5, 16.0), "balanced": (2**0.5, 16.0), "high": (1.0, 1.0)}
MAX_ZEROS = 16  # last bits of a position, at most
TURN_STEP = {"small": 4, "balanced": 4, "high": 1}  # levels of quaternions, of 511


@dataclass(frozen=True)
class SpzHeader:
    """The numbers that begin a file."""

    version: int
    count: int
    degree: int
    fraction: int  # bits
    flags: int

    @classmethod
    def parse(cls, path: Path, data: bytes) -> "SpzHeader":
        """Take them from the first bytes.  Raises DataError where they cannot be."""
        if len(data) < HEADER or data[:4] != MAGIC:
            raise DataError(f"{path}: not an SPZ file; expected its header of {HEADER} bytes: copy or export it again")
        version, count, degree, fraction, flags = struct.unpack_from("<2I3B", data, 4)
        if not 1 <= version <= 4 or degree > STORED_DEGREE or fraction > 23:
            raise DataError(
                f"{path}: SPZ of version {version}, SH degree {degree}, {fraction} fractional bits; expected version "
                "1 to 4, degree 0 to 4, at most 23 bits: export it again"
            )
        return cls(version, count, degree, fraction, flags)

    @property
    def sizes(self) -> list[int]:
        """Bytes of each plane."""
        widths = (6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4)
        return [self.count * width for width in (*widths, 3 * (sh_coefficients(self.degree) - 1))]


def unpacked(header: SpzHeader, planes: Sequence[Callable[[int], bytes]]) -> Parameters:
    """Return the parameters that the bytes of the planes stand for: of each, what returns the next so many bytes."""
    byte = np.arange(256, dtype=np.float32)
    levels = {
        "logit_opacity": logits(np.arange(256) / 255.0),
        "sh_base": ((np.arange(256) / 255.0 - 0.5) / COLOR).astype(np.float32),
        "log_scales": byte / np.float32(16) - np.float32(10),
        "sh_rest": (byte - np.float32(128)) / np.float32(128),
    }
    columns = 3 * (sh_coefficients(min(header.degree, MAX_DEGREE)) - 1)
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": columns}
    found = {name: np.empty((header.count, widths[name]), np.float32) for name in PARAMETERS}
    order = ("means", "logit_opacity", "sh_base", "log_scales", "quats", "sh_rest")
    for name, size, plane in zip(order, header.sizes, planes, strict=False):  # of degree 0 there may be no last one
        for start in range(0, header.count if size else 0, ROWS):
            part = found[name][start : start + ROWS]
            data = np.frombuffer(plane(size // header.count * len(part)), np.uint8).reshape(len(part), -1)
            if name == "means":
                part[:] = _positions(header, data)
            elif name == "quats":
                part[:] = _three_bytes(data) if header.version < 3 else _four_bytes(data)
            else:
                part[:] = levels[name][data[:, : widths[name]]]
    return found


def _positions(header: SpzHeader, data: NDArray[np.uint8]) -> NDArray[np.float32]:
    if header.version == 1:
        return data.view("<f2").astype(np.float32)
    low, middle, high = data.reshape(-1, 3).astype(np.int32).T
    whole = (low | middle << 8 | (high ^ 128) << 16) - (1 << 23)
    return (whole.astype(np.float32) / np.float32(2**header.fraction)).reshape(-1, 3)


def _three_bytes(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def _four_bytes(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    bits = packed.view("<u4")[:, 0]
    parts = [bits >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    others = np.stack([(part & 511) / 511 * 0.5**0.5 * np.where(part & 512, -1, 1) for part in parts], axis=1)
    xyzw = from_smallest_three((bits >> np.uint32(30)).astype(np.intp), others)
    return np.roll(xyzw, 1, axis=1)


def fraction_of(path: Path, means: NDArray[np.float32], fine: bool) -> int:
    """Return bits after the point with which every position fits into 24; where they are few, say so.

    Raises DataError for positions that do not fit without any.
    """
    largest = float(np.abs(means).max(initial=0))
    bits = min(FINE_FRACTION if fine else FRACTION, math.floor(math.log2(MAX_INT24 / max(largest, 1e-9))))
    if bits < 0:
        raise DataError(f"{path}: SPZ holds positions to {MAX_INT24}; the model has {largest:g}: crop it")
    if bits < FRACTION:
        LOG.warning(
            "%s: its largest coordinate is %g: SPZ keeps all positions in steps of %.3g, not %.3g, scene units; a crop "
            "keeps them finer",
            path,
            largest,
            2.0**-bits,
            2.0**-FRACTION,
        )
    return bits


def packed(path: Path, p: Parameters, weights: NDArray[np.float64], fraction: int, options: Writing) -> list[bytes]:
    """Return the bytes of each plane; values beyond its range are cut.

    weights: binary logarithms, [N], of `log_weights`.  Gaussians whose harmonics have fine steps come first, and keep
    their order among themselves: alike bytes compress.
    """
    sh_steps = _sh_steps(p["sh_rest"], weights, options)
    order = np.argsort(sh_steps, kind="stable")
    p, weights = {name: table[order] for name, table in p.items()}, weights[order]
    harmonics, base = _rounded_sh(p, sh_steps[order], options.sh_bits)
    cut = {
        "alphas": 255 * opacities(p["logit_opacity"]),
        "colors": 255 * (COLOR * base.astype(np.float64) + 0.5),
        "scales": 16 * (p["log_scales"].astype(np.float64) + 10),
    }
    warn_clipped(path, "SPZ", "harmonics from -1 to 1", np.abs(p["sh_rest"]) > 1)
    warn_clipped(path, "SPZ", "colors from -0.44 to 1.44", outside_bytes(cut["colors"]))
    warn_clipped(path, "SPZ", "scales from 4.5e-05 to 379", outside_bytes(cut["scales"]))
    step = quantization_steps(weights, *BASE_STEP[options.quality])[:, None]
    cut["colors"] = np.rint(cut["colors"] / step) * step
    alphas, colors, scales = (np.clip(np.rint(v), 0, 255).astype(np.uint8).tobytes() for v in cut.values())
    positions = _fixed(p, weights, fraction, SMALLEST_SHARE[options.quality])
    rotations = _rotations(p["quats"], TURN_STEP[options.quality])
    return [positions, alphas, colors, scales, rotations, harmonics.tobytes()]


def _fixed(p: Parameters, weights: NDArray[np.float64], fraction: int, share: float) -> bytes:
    """Positions in 24 bits, in steps of about `share` of the smallest standard deviation, and more where weights are
    small: powers of two."""
    size = p["log_scales"].min(axis=1, keepdims=True).astype(np.float64) / np.log(2) - weights[:, None] / 2
    step = np.exp2(np.clip(np.floor(size + np.log2(share) + fraction), 0, MAX_ZEROS)) if share else 1.0
    multiples = np.rint(p["means"].astype(np.float64) * 2**fraction / step) * step
    fixed = np.minimum(multiples, MAX_INT24 + 1 - step).astype("<i4")
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 4)[:, :3]).tobytes()


def _rotations(quats: NDArray[np.float32], step: int) -> bytes:
    """The three smallest components of quaternions in 9 bits, as multiples of `step`, their signs, and which."""
    largest, others = smallest_three(np.roll(unit(quats), -1, axis=1))
    multiples = np.rint(511 / step * np.abs(others) * 2**0.5) * step
    levels = np.minimum(multiples, 511).astype(np.uint32)
    levels |= (others < 0).astype(np.uint32) << np.uint32(9)
    rotations = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        rotations |= levels[:, i] << np.uint32(shift)
    return rotations.astype("<u4").tobytes()


def _sh_steps(rest: NDArray[np.float32], weights: NDArray[np.float64], options: Writing) -> NDArray[np.float32]:
    """The step of the harmonics of each Gaussian, [N] levels; 1 for all where bits are given, or all are kept."""
    most = LARGEST_STEP[options.quality]
    if options.sh_bits or most == 1 or not rest.shape[1]:
        return np.ones(len(rest), np.float32)
    return quantization_steps(weights, usual_step(rest, *MEDIAN_STEP[options.quality]), most)


def _rounded_sh(
    p: Parameters, sh_steps: NDArray[np.float32], bits: tuple[int, int] | None
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Harmonics as levels, 128 for 0: multiples of each Gaussian's step, or of 2^(8 - bits); and band 0, which takes up
    the errors of the first."""
    rest = p["sh_rest"]
    levels = np.clip(rest, -1, 1) * np.float32(128)
    if bits is None and sh_steps.max(initial=1) > 1:
        form = visible_form(rest)
        found = np.clip(round_sh(levels, sh_steps, form), -128, 128 - sh_steps[:, None])
        base = compensate_base(p["sh_base"], rest - found / 128, form)
    else:
        columns = np.full(rest.shape[1], 2.0 ** (8 - (bits or WHOLE)[1]), np.float32)
        columns[:9] = 2.0 ** (8 - (bits or WHOLE)[0])
        found, base = np.rint(levels / columns) * columns, p["sh_base"]
    return np.asarray(np.clip(found + 128, 0, 255), np.uint8), base


# Zstandard, of Python from 3.14 on, else of the package zstandard, which is an extra.

MAX_WINDOW = 27  # log2 of bytes: what a stream may ask the decoder to hold


class ZstdFrame:
    """A frame that holds `size` bytes, read a part at a time.  Raises DataError for another size or a bad frame."""

    def __init__(self, path: Path, data: bytes, size: int) -> None:
        module, builtin = _module()
        self.path, self.size, self.left, self.error = path, size, size, module.ZstdError
        self.stream = _stream(module, builtin, data)

    def read(self, size: int) -> bytes:
        """Return the next bytes, so many."""
        found = self._some(size)
        self.left -= size
        if len(found) != size or (not self.left and self._some(1)):
            end = "ends early" if len(found) != size else "goes on"
            raise DataError(f"{self.path}: a stream {end}; expected {self.size} bytes: copy or export the file again")
        return found

    def _some(self, size: int) -> bytes:
        try:
            found: bytes = self.stream.read(size)
        except (self.error, EOFError) as error:
            raise DataError(f"{self.path}: a stream is damaged ({error}); copy or export the file again") from error
        return found


def _stream(module: ModuleType, builtin: bool, data: bytes) -> Any:
    if builtin:
        limit = {module.DecompressionParameter.window_log_max: MAX_WINDOW}
        return module.ZstdFile(io.BytesIO(data), options=limit)
    return module.ZstdDecompressor(max_window_size=1 << MAX_WINDOW).stream_reader(data)


def _module() -> tuple[ModuleType, bool]:
    """The module, and whether it is that of Python itself."""
    try:
        from compression import zstd

        return zstd, True
    except ImportError:
        pass
    try:
        import zstandard

        return zstandard, False
    except ImportError as error:
        raise ConfigError("SPZ of version 4 needs Zstandard; install it: pip install 'clsplat[spz]'") from error


WRITTEN_VERSION = 3  # more programs read it than version 4
HEADER4 = 32  # bytes, of version 4
LEVEL = 12  # of deflate
GZIP_RATIO = 1032  # most bytes that one byte of deflate can stand for
RATIO4 = 1024  # most bytes of positions that one byte of version 4 may stand for, as in Niantic's library
ALIKE = 1 << 27  # bytes of all planes that a file of version 4 of any size may stand for: 0.6 GB in memory
BLOCK = 1 << 16  # bytes at once
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
        flip_axes_in_place(parameters)
    if options.axes == "spz" and not options.quiet:
        LOG.info("%s: axes as the format says (up, back); if it stands on its head, `clsplat convert --axes ply`", path)
    return SplatFile(parameters, {}, "mip" if header.flags & MIP else "default")


def write_spz(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write splats, those with finer harmonics first, else along a Morton curve.

    Raises OutputError; DataError where positions are too large.
    """
    require_gaussians(path, splats)
    require_in_range(path, splats, "SPZ")  # one value that is not finite would spoil the harmonics of all
    p = splats.rows(morton_order(splats.parameters["means"])).parameters
    weights = log_weights(p, splats.has_sky)
    fraction = fraction_of(path, p["means"], options.quality == "high")
    planes = packed(path, flip_axes(p) if options.axes == "spz" else p, weights, fraction, options)
    numbers = (WRITTEN_VERSION, len(splats), splats.sh_degree, fraction, MIP if splats.mode == "mip" else 0)
    return write_bytes(path, _gzip(MAGIC + struct.pack("<2I4B", *numbers, 0) + b"".join(planes)))


def _gzip(data: bytes) -> bytes:
    """Bytes as one member of gzip."""
    import deflate  # here, as only this needs it

    check = struct.pack("<2I", zlib.crc32(data), len(data) & 0xFFFFFFFF)
    return GZIP_START + deflate.deflate_compress(data, LEVEL) + check


def _unpacked(path: Path, data: bytes) -> tuple[SpzHeader, Parameters]:
    """Header and parameters of versions 1 to 3."""
    stream = _Gzip(path, data)
    header = SpzHeader.parse(path, stream.read(HEADER))
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


def _unpacked_4(path: Path, data: bytes) -> tuple[SpzHeader, Parameters]:
    """Header and parameters of version 4."""
    header = SpzHeader.parse(path, data)
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
    _check_size(path, header, sum(header.sizes), max(len(data) * RATIO4, ALIKE))
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
        frames.append(ZstdFrame(path, data[start : start + held], size))
        start += held
    if start != len(data):
        raise DataError(f"{path}: goes on after its last stream, at byte {start}; copy or export it again")
    return header, unpacked(header, [frame.read for frame in frames])


def _check_size(path: Path, header: SpzHeader, size: int, most: int) -> None:
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
