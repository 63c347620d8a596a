"""Read SPZ files of Niantic, versions 1 to 4, and write version 3.

Planes of bytes are compressed with gzip (versions 1 to 3) or Zstandard (4):

    header     u32 magic, version, splats · u8 SH degree, fractional bits, flags, 0; in version 4 instead of the 0: u8
               streams, u32 offset of their table (u64 packed, u64 unpacked size each), 12 bytes of 0
    positions  int24 of x 2^bits (version 1: float16) · alphas  255 opacity · colors  255 (0.15 f_dc + 1/2)
    scales     16 (log s + 10) · rotations  index of the largest of x y z w << 30, the other three as a sign and 9 bits
               of 511 |c| sqrt 2 (versions 1, 2: x y z as 127.5 c + 127.5, where w >= 0)
    harmonics  128 f + 128, coefficient-major, f rounded to multiples of 1/2^(bits - 1)

Axes are x right, y up, z back, unless an extension record names others.  Some programs keep the axes of the PLY without
declaring them.
"""

import io
import logging
import math
import struct
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.reading import read_file, require_content
from clsplat.formats.packing import (
    exceeds_byte,
    from_smallest_three,
    morton_order,
    smallest_three,
    warn_clipped,
    write_bytes,
)
from clsplat.formats.sog_quantize import (
    compensate_base,
    log_weights,
    quantization_steps,
    round_sh,
    scaled_step,
    visible_form,
)
from clsplat.formats.splats import (
    MAX_DEGREE,
    MAX_FILE,
    MAX_STORED_DEGREE,
    PARAMETERS,
    Parameters,
    ReadOptions,
    SplatFile,
    WriteOptions,
    flip_axes,
    flip_axes_in_place,
    logits,
    normalize_quats,
    opacities,
    require_gaussians,
    require_in_range,
    require_memory,
    sh_coefficients,
    transform,
    typical_size,
    warn_dropped,
)

# Pack and unpack the planes of an SPZ file.

LOG = logging.getLogger("clsplat")
MAGIC = b"NGSP"
MIP, EXTENSIONS = 1, 2  # flags
HEADER = 16  # bytes
COLOR = 0.15
MAX_INT24 = 2**23 - 1
FRACTION, FINE_FRACTION = 12, 20  # fractional bits of positions; the second for quality `high`
COARSE, MAX_FRACTION = 2, 23  # models smaller than 2^-COARSE scene units get more bits; readers accept up to 23
ROWS = 1 << 13  # rows decoded at once, to limit temporary memory
# steps of SH coefficients, in units of 1/128: the typical and the largest step for a Gaussian of median weight, and the
# largest step for any Gaussian
MEDIAN_STEP = {"small": (7.5, 12.5), "balanced": (3.0, 5.0), "high": (1.0, 1.0)}
MAX_STEP = {"small": 128.0, "balanced": 64.0, "high": 1.0}
# step of positions for a Gaussian of median weight, relative to its smallest scale
POSITION_STEP = {"small": 0.5, "balanced": 0.5, "high": 0.0}
# steps of colors, in units of 1/255: for a Gaussian of median weight, and the largest
BASE_STEP = {"small": (2**0.5, 16.0), "balanced": (2**0.5, 16.0), "high": (1.0, 1.0)}
MAX_ZEROS = 16  # last bits of a position that may be zeroed
QUAT_STEP = {"small": 4, "balanced": 4, "high": 1}  # step of quaternions, in units of sqrt(1/2) / 511


@dataclass(frozen=True)
class SpzHeader:
    """The header of an SPZ file."""

    version: int
    count: int
    degree: int
    fraction: int  # fractional bits of positions
    flags: int

    @classmethod
    def parse(cls, path: Path, data: bytes) -> "SpzHeader":
        """Parse the header in the first bytes of a file.  Raises DataError if it is invalid."""
        if len(data) < HEADER or data[:4] != MAGIC:
            raise DataError(f"{path}: not an SPZ file, or shorter than its header of {HEADER} bytes; export it again")
        version, count, degree, fraction, flags = struct.unpack_from("<2I3B", data, 4)
        if not 1 <= version <= 4 or degree > MAX_STORED_DEGREE or fraction > 23:
            raise DataError(
                f"{path}: SPZ version {version}, SH degree {degree}, {fraction} fractional bits; expected version "
                "1 to 4, degree 0 to 4, at most 23 bits; export it again"
            )
        return cls(version, count, degree, fraction, flags)

    @property
    def sizes(self) -> list[int]:
        """The uncompressed sizes of the planes, in bytes, in the order of the file."""
        widths = (6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4)
        return [self.count * width for width in (*widths, 3 * (sh_coefficients(self.degree) - 1))]


def unpack_planes(header: SpzHeader, planes: Sequence[Callable[[int], bytes]]) -> Parameters:
    """Decode the planes of a file.  planes: a function per plane, which takes n and returns the next n bytes."""
    byte = np.arange(256, dtype=np.float32)
    levels = {
        "logit_opacity": logits(np.arange(256) / 255.0),
        "sh_base": ((np.arange(256) / 255.0 - 0.5) / COLOR).astype(np.float32),
        "log_scales": byte / np.float32(16) - np.float32(10),
        "sh_rest": (byte - np.float32(128)) / np.float32(128),
    }
    columns = 3 * (sh_coefficients(min(header.degree, MAX_DEGREE)) - 1)
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": columns}
    parameters = {name: np.empty((header.count, widths[name]), np.float32) for name in PARAMETERS}
    order = ("means", "logit_opacity", "sh_base", "log_scales", "quats", "sh_rest")
    for name, size, plane in zip(order, header.sizes, planes, strict=False):  # degree 0 may have no last plane
        for start in range(0, header.count if size else 0, ROWS):
            block = parameters[name][start : start + ROWS]
            data = np.frombuffer(plane(size // header.count * len(block)), np.uint8).reshape(len(block), -1)
            if name == "means":
                block[:] = _unpack_positions(header, data)
            elif name == "quats":
                block[:] = _unpack_3_byte_quats(data) if header.version < 3 else _unpack_4_byte_quats(data)
            else:
                block[:] = levels[name][data[:, : widths[name]]]
    return parameters


def _unpack_positions(header: SpzHeader, data: NDArray[np.uint8]) -> NDArray[np.float32]:
    if header.version == 1:
        return data.view("<f2").astype(np.float32)
    low, middle, high = data.reshape(-1, 3).astype(np.int32).T
    integers = (low | middle << 8 | (high ^ 128) << 16) - (1 << 23)
    return (integers.astype(np.float32) / np.float32(2**header.fraction)).reshape(-1, 3)


def _unpack_3_byte_quats(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def _unpack_4_byte_quats(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    bits = packed.view("<u4")[:, 0]
    fields = [bits >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    components = np.stack([(field & 511) / 511 * 0.5**0.5 * np.where(field & 512, -1, 1) for field in fields], axis=1)
    xyzw = from_smallest_three((bits >> np.uint32(30)).astype(np.intp), components)
    return np.roll(xyzw, 1, axis=1)


def choose_fraction_bits(path: Path, means: NDArray[np.float32], is_fine: bool) -> int:
    """Return the largest useful number of fractional bits with which positions fit into 24 bits; warn if it is small.

    Raises DataError if positions do not fit even without fractional bits.
    """
    max_value = float(np.abs(means).max(initial=0))
    extra_bits = max(0, round(-math.log2(typical_size(means))) - COARSE)  # positive for a large unit of length
    target_bits = min((FINE_FRACTION if is_fine else FRACTION) + extra_bits, MAX_FRACTION)
    bits = min(target_bits, math.floor(math.log2(MAX_INT24 / max(max_value, 1e-9))))
    if bits < 0:
        raise DataError(
            f"{path}: SPZ stores positions up to {MAX_INT24}, but the model reaches {max_value:g}; crop the model"
        )
    if bits < min(FRACTION + extra_bits, MAX_FRACTION):
        LOG.warning(
            "%s: because of its largest coordinate, %g, SPZ rounds all positions to %.3g instead of %.3g scene units; "
            "crop the model for more precision",
            *(path, max_value, 2.0**-bits, 2.0**-target_bits),
        )
    return bits


def pack_planes(
    path: Path, p: Parameters, weights: NDArray[np.float64], bits: int, options: WriteOptions
) -> list[bytes]:
    """Return the bytes of the planes.  Values outside their range are clipped, with a warning.

    weights: base-2 logarithms, [N], from `log_weights`.  Gaussians with fine SH steps come first, because
    similar bytes compress better; Gaussians with equal steps keep their order.
    """
    sh_steps = _sh_steps(p["sh_rest"], weights, options)
    order = np.argsort(sh_steps, kind="stable")
    p, weights = {name: table[order] for name, table in p.items()}, weights[order]
    harmonics, base = _round_sh_bands(p, sh_steps[order])
    levels = {
        "alphas": 255 * opacities(p["logit_opacity"]),
        "colors": 255 * (COLOR * base.astype(np.float64) + 0.5),
        "scales": 16 * (p["log_scales"].astype(np.float64) + 10),
    }
    warn_clipped(path, "SPZ", "SH coefficients from -1 to 1", np.abs(p["sh_rest"]) > 1)
    warn_clipped(path, "SPZ", "colors from -0.44 to 1.44", exceeds_byte(levels["colors"]))
    warn_clipped(path, "SPZ", "scales from 4.5e-05 to 379", exceeds_byte(levels["scales"]))
    step = quantization_steps(weights, *BASE_STEP[options.quality])[:, None]
    levels["colors"] = np.rint(levels["colors"] / step) * step
    alphas, colors, scales = (np.clip(np.rint(v), 0, 255).astype(np.uint8).tobytes() for v in levels.values())
    positions = _encode_positions(p, weights, bits, POSITION_STEP[options.quality])
    rotations = _encode_rotations(p["quats"], QUAT_STEP[options.quality])
    return [positions, alphas, colors, scales, rotations, harmonics.tobytes()]


def _encode_positions(p: Parameters, weights: NDArray[np.float64], fraction: int, relative: float) -> bytes:
    """Encode coordinates in 24 bits, rounded to multiples of a step for each Gaussian.

    The step is a power of two near `relative` times the smallest scale for a Gaussian of median weight, and
    proportional to 1 / sqrt(weight).
    """
    size = p["log_scales"].min(axis=1, keepdims=True).astype(np.float64) / np.log(2) - weights[:, None] / 2
    step = np.exp2(np.clip(np.floor(size + np.log2(relative) + fraction), 0, MAX_ZEROS)) if relative else 1.0
    multiples = np.rint(p["means"].astype(np.float64) * 2**fraction / step) * step
    fixed_point = np.minimum(multiples, MAX_INT24 + 1 - step).astype("<i4")
    return np.ascontiguousarray(fixed_point.view(np.uint8).reshape(-1, 4)[:, :3]).tobytes()


def _encode_rotations(quats: NDArray[np.float32], step: int) -> bytes:
    """Encode the three smallest components of quaternions in 9 bits each, as multiples of `step`, with signs."""
    largest_index, components = smallest_three(np.roll(normalize_quats(quats), -1, axis=1))
    multiples = np.rint(511 / step * np.abs(components) * 2**0.5) * step
    levels = np.minimum(multiples, 511).astype(np.uint32)
    levels |= (components < 0).astype(np.uint32) << np.uint32(9)
    rotations = largest_index.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        rotations |= levels[:, i] << np.uint32(shift)
    return rotations.astype("<u4").tobytes()


def _sh_steps(rest: NDArray[np.float32], weights: NDArray[np.float64], options: WriteOptions) -> NDArray[np.float32]:
    """Return the rounding step of each Gaussian's SH, [N], in units of 1/128; all steps are 1 for quality `high`."""
    max_step = MAX_STEP[options.quality]
    if max_step == 1 or not rest.shape[1]:
        return np.ones(len(rest), np.float32)
    return quantization_steps(weights, scaled_step(rest, *MEDIAN_STEP[options.quality]), max_step)


def _round_sh_bands(p: Parameters, sh_steps: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the SH above band 0 as bytes, 128 for 0, rounded to multiples of each Gaussian's step.

    Also return band 0, corrected for the rounding errors.
    """
    rest = p["sh_rest"]
    levels = np.clip(rest, -1, 1) * np.float32(128)
    if sh_steps.max(initial=1) > 1:
        form = visible_form(rest)
        rounded_sh = np.clip(round_sh(levels, sh_steps, form), -128, 128 - sh_steps[:, None])
        base = compensate_base(p["sh_base"], rest - rounded_sh / 128, form)
    else:
        rounded_sh, base = np.rint(levels), p["sh_base"]
    return np.asarray(np.clip(rounded_sh + 128, 0, 255), np.uint8), base


# Zstandard comes from Python 3.14 or newer, or else from the optional package zstandard.

MAX_WINDOW = 27  # log2 of the largest window that a stream may request, in bytes


class ZstdFrame:
    """A Zstandard frame that is read in parts.

    Reading raises DataError if the frame is damaged or does not decompress to `size` bytes.
    """

    def __init__(self, path: Path, data: bytes, size: int) -> None:
        self.path, self.size, self.bytes_left = path, size, size
        self.stream, self.error = _open_zstd(data)

    def read(self, size: int) -> bytes:
        """Return the next `size` decompressed bytes.  Raises DataError."""
        data = self._read(size)
        self.bytes_left -= size
        if len(data) != size or (not self.bytes_left and self._read(1)):
            fault = "too short" if len(data) != size else "too long"
            raise DataError(f"{self.path}: a stream is {fault}; expected {self.size} bytes; copy or export it again")
        return data

    def _read(self, size: int) -> bytes:
        try:
            data: bytes = self.stream.read(size)
        except (self.error, EOFError) as error:
            raise DataError(f"{self.path}: a stream is damaged ({error}); copy or export the file again") from error
        return data


def _open_zstd(data: bytes) -> tuple[Any, type[Exception]]:
    """Return a stream that decompresses a frame, and the type of the error that it raises if the frame is damaged."""
    with suppress(ImportError):
        from compression import zstd

        limit = {zstd.DecompressionParameter.window_log_max: MAX_WINDOW}
        return zstd.ZstdFile(io.BytesIO(data), options=limit), zstd.ZstdError
    try:
        import zstandard
    except ImportError as error:
        raise ConfigError("SPZ version 4 needs Zstandard; in a checkout, run `pip install '.[spz]'`") from error
    return zstandard.ZstdDecompressor(max_window_size=1 << MAX_WINDOW).stream_reader(data), zstandard.ZstdError


WRITTEN_VERSION = 3  # more programs read it than version 4
HEADER4 = 32  # bytes, in version 4
LEVEL = 12  # compression level of deflate
DEFLATE_RATIO = 1032  # largest compression ratio of deflate
MAX_RATIO = 32  # largest accepted compression ratio; real files have less than 8
MIN_LIMIT = 1 << 26  # bytes of planes that a file of any size may decompress to: 0.3 GB in memory
BLOCK = 1 << 16  # bytes read at once
GZIP_START = b"\x1f\x8b\x08\0\0\0\0\0\2\xff"  # no time or system, so that the same model is written as the same bytes
AXES_RECORD = 0xADBE0003  # an extension of Adobe; it contains 1 + the index of a name in AXES, or 0
AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU")
DEFAULT_AXES = "RUB"
QUARTER_TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # makes y the vertical axis
EXPECTED = "an SPZ file"


def read_spz(path: Path, options: ReadOptions) -> SplatFile:
    """Read an SPZ file.  Raises DataError if it is missing or damaged, MemoryLimitError if it is too large."""
    splats, axes = decode_spz(path, read_file(path, EXPECTED, limit=MAX_FILE))
    if not options.quiet:
        remedy = "if the model is upside down, use `clsplat convert --transform 'rotate=180,0,0'`"
        LOG.info("%s: read with the axes %s", path, f"that it declares, {axes}" if axes else f"of SPZ; {remedy}")
    return splats


def decode_spz(path: Path, data: bytes) -> tuple[SplatFile, str]:
    """Decode an SPZ file; return the splats and the declared axes ('' if none).  Raises errors like `read_spz`."""
    is_version_4 = data[:4] == MAGIC and SpzHeader.parse(path, data).version == 4
    header, parameters, axes = (_decode_version_4 if is_version_4 else _decode_gzip)(path, data)
    warn_dropped(path, header.degree)
    name = axes or DEFAULT_AXES
    if name[1] in "BF":  # z is vertical
        rotated_tables = transform(parameters, 1.0, QUARTER_TURN, 0.0)
        parameters |= {table: values.astype(np.float32) for table, values in rotated_tables.items()}
        name = name[0] + name[2] + ("B" if name[1] == "F" else "F")
    flip_axes_in_place(parameters, [1.0 if letter in "RDF" else -1.0 for letter in name])
    return SplatFile(parameters, {}, "mip" if header.flags & MIP else "default"), axes


def write_spz(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write an SPZ file and return its SHA-256.

    Splats with finer SH steps come first; splats with equal steps follow a Morton curve.
    Raises OutputError, and DataError if the model is empty or has values outside the range of the format.
    """
    require_gaussians(path, splats)
    require_in_range(path, splats, "SPZ")  # one invalid value would spoil the SH of all Gaussians
    p = splats.rows(morton_order(splats.parameters["means"])).parameters
    weights = log_weights(p, splats.has_sky)
    fraction = choose_fraction_bits(path, p["means"], options.quality == "high")
    planes = pack_planes(path, flip_axes(p), weights, fraction, options)
    header_values = (WRITTEN_VERSION, len(splats), splats.sh_degree, fraction, MIP if splats.mode == "mip" else 0)
    return write_bytes(path, _gzip(MAGIC + struct.pack("<2I4B", *header_values, 0) + b"".join(planes)))


def _gzip(data: bytes) -> bytes:
    """Compress bytes as one gzip member."""
    import deflate  # imported here because only this function needs it

    trailer = struct.pack("<2I", zlib.crc32(data), len(data) & 0xFFFFFFFF)
    return GZIP_START + deflate.deflate_compress(data, LEVEL) + trailer


def _decode_gzip(path: Path, data: bytes) -> tuple[SpzHeader, Parameters, str]:
    """Decode the header, parameters, and declared axes of a file of version 1 to 3, compressed with gzip or not."""
    stream = io.BytesIO(data) if data[:4] == MAGIC else _GzipReader(path, data)
    start = stream.read(HEADER)
    if start[:3] == b"ply":
        require_content(path, data)  # reports that the PLY is compressed
    header = SpzHeader.parse(path, start)
    if header.version > 3:
        raise DataError(f"{path}: SPZ version 4 must use Zstandard, not gzip; export it again")
    _check_size(
        path, header, len(data) if data[:4] == MAGIC else min(len(data) * DEFLATE_RATIO, _max_decoded_size(data))
    )

    def read(size: int) -> bytes:
        if len(part := stream.read(size)) < size:
            expected = HEADER + sum(header.sizes)
            raise DataError(
                f"{path}: is too short for {header.count} splats, which take {expected} bytes; copy or export it again"
            )
        return part

    parameters = unpack_planes(header, [read] * len(header.sizes))
    axes = _read_axes(path, stream.read) if header.flags & EXTENSIONS else ""
    if stream.read(1):
        raise DataError(f"{path}: has data after its {header.count} splats; copy or export it again")
    if isinstance(stream, _GzipReader):
        stream.require_end()
    return header, parameters, axes


class _GzipReader:
    """The decompressed content of a gzip file, read in parts.  Reading raises DataError if a member is damaged."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.data, self.file, self.stream = path, data, io.BytesIO(data), zlib.decompressobj(31)

    def read(self, size: int) -> bytes:
        """Return the next `size` decompressed bytes, or fewer at the end of the content."""
        data = bytearray()
        while len(data) < size and (not self.stream.eof or self._start_member()):
            packed = self.stream.unconsumed_tail or self.file.read(BLOCK)
            try:
                part = self.stream.decompress(packed, size - len(data))
            except zlib.error as error:
                raise DataError(
                    f"{self.path}: {error}; expected {EXPECTED} in gzip; copy or export it again"
                ) from error
            if not packed and not part:
                break
            data += part
        return bytes(data)

    def _start_member(self) -> bool:
        """Start the next gzip member, and return whether there is one."""
        start = self.file.tell() - len(self.stream.unused_data)
        if self.data[start : start + 2] != b"\x1f\x8b":
            return False
        self.file.seek(start)
        self.stream = zlib.decompressobj(31)
        return True

    def require_end(self) -> None:
        """Raise DataError if the last gzip member is incomplete or followed by other data."""
        if not self.stream.eof:
            raise DataError(f"{self.path}: is truncated before the checksum of its gzip data; copy or export it again")
        if trailing_bytes := len(self.stream.unused_data) + len(self.file.read()):
            raise DataError(f"{self.path}: has {trailing_bytes} bytes after its gzip data; copy or export it again")


def _decode_version_4(path: Path, data: bytes) -> tuple[SpzHeader, Parameters, str]:
    """Decode the header, parameters, and declared axes of version 4."""
    header = SpzHeader.parse(path, data)
    if len(data) < HEADER4:
        raise DataError(f"{path}: has {len(data)} bytes; expected {HEADER4} bytes of header; copy or export it again")
    stream_count, table_start = struct.unpack_from("<BI", data, HEADER - 1)
    sizes = [size for size in header.sizes if size]
    if stream_count != len(sizes) or not HEADER4 <= table_start <= len(data) - 16 * stream_count:
        raise DataError(
            f"{path}: has {stream_count} streams and their table at byte {table_start}; expected {len(sizes)} streams "
            f"within {len(data)} bytes; copy or export it again"
        )
    _check_size(path, header, _max_decoded_size(data))
    axes = _read_axes(path, io.BytesIO(data[HEADER4:table_start]).read) if header.flags & EXTENSIONS else ""
    start, frames = table_start + 16 * stream_count, []
    for index, size in enumerate(sizes):
        length, unpacked_size = struct.unpack_from("<2Q", data, table_start + 16 * index)
        if unpacked_size != size or length > len(data) - start:
            raise DataError(
                f"{path}: declares {length} bytes for stream {index}, and {unpacked_size} after decompression; "
                f"expected {size} decompressed bytes for {header.count} splats, and a stream inside the file; "
                "copy or export it again"
            )
        frames.append(ZstdFrame(path, data[start : start + length], size))
        start += length
    if start != len(data):
        raise DataError(f"{path}: has data after its last stream, at byte {start}; copy or export it again")
    return header, unpack_planes(header, [frame.read for frame in frames]), axes


def _max_decoded_size(data: bytes) -> int:
    """Return the accepted maximum size, in bytes, of the decompressed planes of a file."""
    return max(len(data) * MAX_RATIO, MIN_LIMIT)


def _check_size(path: Path, header: SpzHeader, limit: int) -> None:
    """Raise DataError if the declared splats take more than `limit` bytes, MemoryLimitError if memory is too small."""
    if (total := sum(header.sizes)) > limit:
        raise DataError(
            f"{path}: declares {header.count} splats, {total} bytes in total, more than it can contain ({limit}); "
            "the file is truncated or damaged: copy or export it again"
        )
    require_memory(path, header.count, min(header.degree, MAX_DEGREE))


def _read_axes(path: Path, read: Callable[[int], bytes]) -> str:
    """Return the declared axes ('' if none).  Skips other extensions, as Niantic's library does.  Raises DataError."""
    axes = ""
    while len(record := read(8)) == 8:
        record_type, length = struct.unpack("<2I", record)
        if record_type == AXES_RECORD:
            data = read(4) if length == 4 else b""
            if len(data) < 4 or (index := int.from_bytes(data, "little")) > len(AXES):
                raise DataError(
                    f"{path}: its axes record has {length} bytes, {data.hex() or 'nothing'}; expected 4 bytes "
                    f"with a number from 0 to {len(AXES)}; export it again"
                )
            axes = AXES[index - 1] if index else ""
            continue
        while length and (part := read(min(length, BLOCK))):
            length -= len(part)
    return axes
