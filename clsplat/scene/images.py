"""Read the image files of a dataset: headers, pixels, EXIF data; write images."""

import json
import math
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote
from clsplat.core.files import open_atomic, write_text
from clsplat.core.reading import open_file, read_file, read_json, require_content

# Read the size, orientation and completeness of an image file without decoding it.

HEAD_SIZE, TAIL_SIZE = 1 << 18, 1 << 16  # bytes to read at either end
PNG, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
FRAME_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of a frame header
ORIENTATION = 0x0112  # EXIF tag


@dataclass(frozen=True)
class Header:
    """The stored size of an image in pixels, its EXIF orientation (1: upright), and whether the file is complete."""

    width: int
    height: int
    orientation: int = 1
    is_complete: bool = True


def parse_header(head: bytes, tail: bytes, read_all: Callable[[], bytes]) -> Header | None:
    """Return the header of a PNG or JPEG file from its first and last bytes; None for other formats.

    head, tail: up to HEAD_SIZE and TAIL_SIZE bytes.  read_all: returns all bytes of the file; it is called only when
    `tail` does not contain the end marker.
    """
    header = None
    if head.startswith(PNG) and head[12:16] == b"IHDR" and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        header = Header(width, height, is_complete=PNG_END in tail or PNG_END in read_all())
    elif head.startswith(JPEG):
        header = _parse_jpeg_header(head, tail, read_all)
    return header if header and header.width and header.height else None


def is_truncated(data: bytes) -> bool:
    """Return whether the end of a PNG or JPEG file is missing; False for other formats."""
    header = parse_header(data, data[-TAIL_SIZE:], lambda: data)
    return header is not None and not header.is_complete


def _parse_jpeg_header(head: bytes, tail: bytes, read_all: Callable[[], bytes]) -> Header | None:
    """Return the header of a JPEG file, read from its segments; None if they contain no frame header."""
    orientation = 1
    for marker, offset, length in jpeg_segments(head):
        if marker in FRAME_MARKERS:
            height, width = struct.unpack_from(">HH", head, offset + 5)
            # Pixels cannot contain an end marker; a thumbnail has one, but before the frame header.
            is_complete = JPEG_END in tail or read_all().find(JPEG_END, offset) >= 0
            return Header(width, height, orientation, is_complete)
        if _is_exif(head, marker, offset):
            orientation = _read_orientation(head[offset + 10 : offset + 2 + length])
    return None


def find_exif_segment(head: bytes) -> tuple[int, int] | None:
    """Return the offset and length of the EXIF segment in the first bytes of a JPEG file.

    The TIFF block of the segment starts 10 bytes after the offset.  Returns None if there is no such segment.
    """
    matches = ((offset, length) for marker, offset, length in jpeg_segments(head) if _is_exif(head, marker, offset))
    return next(matches, None) if head.startswith(JPEG) else None


def _is_exif(head: bytes, marker: int, offset: int) -> bool:
    return marker == 0xE1 and head[offset + 4 : offset + 10] == b"Exif\0\0"


def jpeg_segments(head: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the marker, offset and length of each segment of a JPEG file, up to the first damaged segment."""
    offset = 2
    while offset + 9 <= len(head) and head[offset] == 0xFF:
        marker = head[offset + 1]
        if marker == 0xFF:  # fill byte
            offset += 1
            continue
        (length,) = struct.unpack_from(">H", head, offset + 2)
        yield marker, offset, length
        offset += 2 + length


def _read_orientation(exif: bytes) -> int:
    """Return the orientation in a TIFF block, 1 to 8; 1 if the block has none."""
    offset = find_orientation(exif)
    value = struct.unpack_from({b"II": "<", b"MM": ">"}[exif[:2]] + "H", exif, offset)[0] if offset else 1
    return int(value) if 1 <= value <= 8 else 1


def find_orientation(exif: bytes) -> int | None:
    """Return the offset of the orientation value (2 bytes) in a TIFF block, or None if there is none."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    if order is None or len(exif) < 8:
        return None
    (start,) = struct.unpack_from(order + "I", exif, 4)
    entry_count = struct.unpack_from(order + "H", exif, start)[0] if start + 2 <= len(exif) else 0
    for offset in range(start + 2, min(start + 2 + 12 * entry_count, len(exif) - 11), 12):
        if struct.unpack_from(order + "H", exif, offset)[0] == ORIENTATION:
            return offset + 8
    return None


# Check PNG files and strip their metadata before OpenCV reads them.

# Chunks to keep in addition to the critical ones, whose names start with a capital letter.
RELEVANT_CHUNKS = {b"tRNS", b"eXIf", b"acTL", b"fcTL", b"fdAT"}


def strip_png_metadata(data: bytes) -> bytes:
    """Return the bytes of a PNG file without its metadata; other files are returned unchanged.

    Raises ValueError with the byte offset when the file is truncated or the checksum of a relevant chunk is wrong.
    """
    if not data.startswith(PNG):
        return data
    view, offset, chunks = memoryview(data), len(PNG), [memoryview(PNG)]
    while offset + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, offset)
        name, end = data[offset + 4 : offset + 8], offset + 12 + length
        if end > len(data):
            break
        if name in RELEVANT_CHUNKS or not name[0] & 0x20:
            if zlib.crc32(view[offset + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
                raise ValueError(f"byte {offset}: the checksum of the chunk {quote(name.decode('latin-1'))} is wrong")
            chunks.append(view[offset:end])
        if name == b"IEND":
            return b"".join(chunks)
        offset = end
    raise ValueError(f"byte {offset}: expected another chunk, but only {len(data) - offset} bytes are left")


cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # OpenCV's messages do not name the file; ours do
MAX_BYTES = (1 << 31) - 1  # largest image file that OpenCV decodes
GRAY_FLAGS = {  # OpenCV's flag for decoding to gray, by the divisor of the size
    1: cv2.IMREAD_GRAYSCALE,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})  # in lower case


def is_image(path: PurePath) -> bool:
    """Return whether a file name has the suffix of an image."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def write_image(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write an RGB or RGBA image, [H, W, 3 or 4], as PNG, and create its folder.  Raises OutputError on failure."""
    assert pixels.dtype == np.uint8, pixels.dtype
    assert pixels.shape[2:] in ((3,), (4,)), pixels.shape
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]]))
    with open_atomic(path) as file:
        file.write(encoded.tobytes())


def read_image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file in pixels.  Raises DataError when it cannot be read."""
    height, width = read_image(path).shape[:2]
    return width, height


def read_header(path: Path) -> Header:
    """Return the header of an image file; formats other than PNG and JPEG are decoded.  Raises DataError."""
    with open_file(path, "an image", limit=MAX_BYTES) as file:
        head = file.read(HEAD_SIZE)
        file.seek(max(0, file.seek(0, 2) - TAIL_SIZE))
        tail = file.read(TAIL_SIZE)
    return parse_header(head, tail, lambda: read_file(path, "an image", limit=MAX_BYTES)) or Header(
        *read_image_size(path)
    )


def read_stored_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file in pixels, as stored.  Raises DataError when it cannot be read."""
    header = read_header(path)
    return header.width, header.height


def read_image(path: Path, upright: bool = False) -> NDArray[Any]:
    """Decode an image file to RGB or RGBA, [H, W, 3 or 4], uint8 or uint16; `upright` applies the EXIF rotation."""
    return decode_image(read_file(path, "an image", limit=MAX_BYTES), path, upright)


def read_gray(path: Path, long_side: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return a photograph in gray, [H, W], with no side longer than `long_side` px, and its scale factors in x and y.

    The EXIF rotation is not applied.  The factors are stored pixels per returned pixel.  Large JPEG files are decoded
    at 1/2, 1/4 or 1/8 of their size, which is faster.  Raises DataError like decode_image.
    """
    data = read_file(path, "an image", limit=MAX_BYTES)
    header = parse_header(data[:HEAD_SIZE], data[-TAIL_SIZE:], lambda: data) if data.startswith(JPEG) else None
    source_side = max(header.width, header.height) if header else 0
    divisor = next((n for n in (8, 4, 2) if source_side >= n * long_side), 1)
    pixels = _decode(data, path, GRAY_FLAGS[divisor] | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = pixels.shape[:2]
    factor = max(1.0, max(height, width) / long_side)
    size = max(1, round(width / factor)), max(1, round(height / factor))
    if size != (width, height):
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return np.asarray(pixels, np.uint8), (divisor * width / size[0], divisor * height / size[1])


def decode_image(data: bytes, path: Path, upright: bool = False) -> NDArray[Any]:
    """Decode the bytes of the image file `path` like read_image.  Raises DataError when they are damaged."""
    pixels = _decode(data, path, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH if upright else cv2.IMREAD_UNCHANGED)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: {pixels.dtype} pixels; expected 8 or 16 bits per channel: convert it to PNG")
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        alpha = []
        if (level := _transparent_gray(data)) is not None:
            alpha = [np.where(pixels == level, 0, np.iinfo(pixels.dtype).max).astype(pixels.dtype)]
        return np.dstack([pixels] * 3 + alpha)
    return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])  # OpenCV decodes to BGR


def _transparent_gray(data: bytes) -> int | None:
    """Return the gray level that a PNG declares transparent, which OpenCV ignores; None for other files."""
    if data[:8] != PNG or len(data) < 26 or data[25] != 0:
        return None
    offset = data.find(b"\0\0\0\2tRNS", 33, data.find(b"IDAT"))
    max_level = (1 << data[24]) - 1
    level = struct.unpack_from(">H", data, offset + 8)[0] & max_level if offset > 0 else None
    return None if level is None else level * max(1, 255 // max_level)


def _reset_orientation(data: bytes) -> bytes:
    """Return the bytes of a TIFF file with upright orientation, since OpenCV always applies the tag.

    Other files are returned unchanged.
    """
    offset = find_orientation(data) if data[:4] in (b"II*\0", b"MM\0*") else None
    return data if offset is None else data[:offset] + (b"\1\0" if data[:1] == b"I" else b"\0\1") + data[offset + 2 :]


def _decode(data: bytes, path: Path, flags: int) -> NDArray[Any]:
    if is_truncated(data):  # some versions of OpenCV would fill the missing rows with gray
        raise DataError(f"{path}: the end of the file is missing; copy it again")
    pixels, fault = None, ""
    if flags & cv2.IMREAD_IGNORE_ORIENTATION:
        data = _reset_orientation(data)
    try:  # not cv2.imread, which needs ASCII paths on Windows
        pixels = cv2.imdecode(np.frombuffer(strip_png_metadata(data), np.uint8), flags)
    except ValueError as error:
        fault = f" ({error})"
    except cv2.error:
        pass
    if pixels is None:
        require_content(path, data)
        raise DataError(f"{path}: not an image, or a damaged one{fault}; copy or export it again")
    return np.asarray(pixels)


# Read the camera settings of a photograph: from EXIF 2.3 in JPEG files, or from a file next to images without EXIF.

EXPOSURES_FILE = "exposures.json"  # file name in a folder of images
EXIF_IFD = 0x8769  # tag with the offset of the exposure tags
GPS_IFD, SOUTH, LATITUDE, WEST, LONGITUDE, BELOW, ALTITUDE = 0x8825, 1, 2, 3, 4, 5, 6  # signs: SOUTH, WEST, BELOW
SECONDS, APERTURE, ISO = 0x829A, 0x829D, 0x8827
MAKE, MODEL, FOCAL, FOCAL_35 = 0x010F, 0x0110, 0x920A, 0xA405  # mm, and mm equivalent for 35 mm film
BYTE, TEXT, SHORT, LONG, RATIONAL = 1, 2, 3, 4, 5  # types of values
PLAUSIBLE = ((1e-7, 1e5), (0.1, 1e3), (0.1, 1e8))  # seconds, f-number, ISO
Value = float | str


@dataclass(frozen=True)
class CameraExposure:
    """The camera settings that determine the brightness of a photograph."""

    seconds: float
    aperture: float  # f-number
    iso: float

    @property
    def value(self) -> float:
        """The exposure in stops: the base-2 logarithm of seconds x ISO / f-number²."""
        return math.log2(self.seconds * self.iso / self.aperture**2)


def read_exif_exposure(path: Path) -> CameraExposure | None:
    """Return the exposure in the EXIF data of a JPEG file, or None if it is missing.  Raises DataError."""
    tags = _read_tags(path)
    return make_exposure(tags.get(SECONDS), tags.get(APERTURE), tags.get(ISO))


def read_exif_optics(path: Path) -> tuple[Value, ...] | None:
    """Return the make, model, focal length and 35 mm focal length in the EXIF data of a JPEG file.

    A missing value is "".  Returns None if both focal lengths are missing.  Raises DataError when the file cannot be
    read.
    """
    tags = _read_tags(path)
    values = [tags.get(tag, "") for tag in (MAKE, MODEL, FOCAL, FOCAL_35)]
    return tuple(values) if any(values[2:]) else None


def read_exif_camera(path: Path) -> tuple[str, bool]:
    """Return the make, model and focal length in the EXIF data of a JPEG file, and whether it has a GPS position.

    The first value is a text such as "Canon EOS R5 35 mm".  Raises DataError when the file cannot be read.
    """
    tags = _read_tags(path)
    make, model, focal = (tags.get(tag, "") for tag in (MAKE, MODEL, FOCAL))
    parts = [] if str(model).startswith(str(make)) else [str(make)]
    parts += [str(model), f"{focal:g} mm" if isinstance(focal, float) else ""]
    return " ".join(filter(None, parts)), LATITUDE in tags and LONGITUDE in tags


def read_exif_position(path: Path) -> tuple[float, float, float] | None:
    """Return the GPS latitude and longitude (degrees) and altitude (m) in the EXIF data of a JPEG file.

    Returns None if one of the three is missing or out of range.  Raises DataError when the file cannot be read.
    """
    tags = _read_tags(path)
    values = [tags.get(tag) for tag in (LATITUDE, LONGITUDE, ALTITUDE)]
    latitude, longitude, altitude = (float(value) if isinstance(value, float) else math.nan for value in values)
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 1e5):
        return None
    signs = [-1 if tags.get(tag) == mark else 1 for tag, mark in ((SOUTH, "S"), (WEST, "W"), (BELOW, 1))]
    return signs[0] * latitude, signs[1] * longitude, signs[2] * altitude


def copy_exif(head: bytes, jpeg: bytes) -> bytes:
    """Return the upright JPEG file `jpeg` with the EXIF data of another file, except for the other file's rotation.

    head: the first bytes of the other file.
    """
    segment = find_exif_segment(head)
    if segment is None:
        return jpeg
    segment_start, length = segment
    block = bytearray(head[segment_start : segment_start + 2 + length])
    if offset := find_orientation(bytes(block[10:])):
        block[10 + offset : 12 + offset] = struct.pack({b"II": "<H", b"MM": ">H"}[bytes(block[10:12])], 1)
    return jpeg[:2] + bytes(block) + jpeg[2:]


def _read_tags(path: Path) -> dict[int, Value]:
    """Return the readable EXIF values of a JPEG file, by tag."""
    with open_file(path, "an image") as file:
        head = file.read(HEAD_SIZE)
    segment = find_exif_segment(head)
    tags: dict[int, Value] = {}
    if segment is None:
        return tags
    segment_start, length = segment
    block = head[segment_start + 10 : segment_start + 2 + length]
    with suppress(struct.error, KeyError, ValueError):  # the data may be truncated, or contain no tags
        order = {b"II": "<", b"MM": ">"}[block[:2]]
        (start,) = struct.unpack_from(order + "I", block, 4)
        tags.update(_read_ifd(block, order, int(start)))
        for pointer in (EXIF_IFD, GPS_IFD):
            if pointer in tags:
                tags.update(_read_ifd(block, order, int(tags[pointer])))
    return tags


def _read_ifd(block: bytes, order: str, start: int) -> dict[int, Value]:
    """Return the values of an image file directory (IFD) by tag.

    Three rationals are degrees, minutes, and seconds; their value is in degrees.  The value of any other array is its
    first element.
    """
    values: dict[int, Value] = {}
    (entry_count,) = struct.unpack_from(order + "H", block, start)
    for entry in range(start + 2, start + 2 + 12 * entry_count, 12):
        tag, value_type, count, value = struct.unpack_from(order + "HHII", block, entry)
        if value_type == RATIONAL:
            numbers = struct.unpack_from(order + "II" * (3 if count == 3 else 1), block, value)
            if numbers[1]:  # 0/0 means that the value is unknown
                pairs = zip(numbers[::2], numbers[1::2], strict=True)
                values[tag] = sum(n / (d or 1) / 60**i for i, (n, d) in enumerate(pairs))
        elif value_type in (BYTE, SHORT, LONG):
            (values[tag],) = struct.unpack_from(
                order + {BYTE: "B", SHORT: "H", LONG: "I"}[value_type], block, entry + 8
            )
        elif value_type == TEXT:
            offset = value if count > 4 else entry + 8
            values[tag] = block[offset : offset + count].split(b"\0")[0].decode("ascii", "replace").strip()
    return values


def make_exposure(seconds: object, aperture: object, iso: object) -> CameraExposure | None:
    """Return the exposure with these settings, or None when a value is missing or implausible for a camera."""
    values = [float(value) for value in (seconds, aperture, iso) if isinstance(value, int | float)]
    is_valid = len(values) == 3 and all(low < x < high for x, (low, high) in zip(values, PLAUSIBLE, strict=True))
    return CameraExposure(*values) if is_valid else None


def write_exposures(folder: Path, exposures: Mapping[str, CameraExposure | None]) -> None:
    """Write the known exposures of the images in a folder, by name.  Without exposures, no file is written.

    Raises OutputError.
    """
    document = {name: asdict(exposure) for name, exposure in exposures.items() if exposure}
    if document:
        write_text(folder / EXPOSURES_FILE, json.dumps(document, indent=1) + "\n")


def read_exposures(folder: Path) -> dict[str, CameraExposure]:
    """Return the exposures of the images in a folder by name, from its exposures file; empty without that file.

    Raises DataError when the file is damaged.
    """
    path = folder / EXPOSURES_FILE
    if not path.is_file():
        return {}
    data, hint = read_json(path, "exposures of images"), "expected {name: {seconds, aperture, iso}}: remove the file"
    if not isinstance(data, dict):
        raise DataError(f"{path}: {hint}")
    exposures = {}
    for name, row in data.items():
        if not isinstance(row, dict) or not (exposure := make_exposure(*map(row.get, ("seconds", "aperture", "iso")))):
            raise DataError(f"{path}: the exposure of {quote(name)} is not three positive numbers; {hint}")
        exposures[name] = exposure
    return exposures
