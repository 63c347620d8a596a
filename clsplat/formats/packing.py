"""Encode values for compact formats (smallest-three quaternions, Morton order, WebP images), and write hashed files."""

import hashlib
import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, OutputError
from clsplat.core.files import open_atomic

LOG = logging.getLogger("clsplat")
EPOCH = (1980, 1, 1, 0, 0, 0)  # time of files in a ZIP, fixed so that the same model gives the same bytes
MORTON_BITS = 21  # bits per axis; three axes fit into 63 bits
_SMALLEST = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the other components, by the index of the largest
_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3))


def smallest_three(quats: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the index of each unit quaternion's largest component, [N], and its other three components, [N, 3].

    The largest component is the one with the largest magnitude.  If it is negative, the quaternion is negated.
    """
    largest_index = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    flipped_quats = np.where(quats[rows, largest_index] < 0, -1.0, 1.0)[:, None] * quats
    return largest_index, flipped_quats[rows[:, None], _SMALLEST[largest_index]]


def from_smallest_three(largest_index: NDArray[np.integer], components: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return unit quaternions [N, 4] from the result of `smallest_three`."""
    quats = np.empty((len(components), 4))
    rows = np.arange(len(components))
    quats[rows[:, None], _SMALLEST[largest_index]] = components
    quats[rows, largest_index] = np.sqrt(np.maximum(1 - np.square(components).sum(axis=1), 0))
    return quats.astype(np.float32)


def morton_order(means: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the row indices, [N], that sort means along a Morton curve through their bounding box."""
    if not len(means):
        return np.zeros(0, np.intp)
    low = means.min(axis=0).astype(np.float64)
    extent = np.maximum(means.max(axis=0) - low, 1e-30)
    cells = np.minimum((means - low) / extent * 2**MORTON_BITS, 2**MORTON_BITS - 1).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits before each of the lowest 21 bits."""
    for shift, mask in (*_SPREAD, (2, 0x1249249249249249)):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values


def exceeds_byte(levels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask, with the shape of `levels`, of the levels that do not round to a number from 0 to 255."""
    return (levels < -0.5) | (levels > 255.5)


def warn_clipped(path: Path, name: str, ranges: str, is_clipped: NDArray[np.bool_]) -> None:
    """Warn about Gaussians with values outside a format's range.  is_clipped: mask of such values, [N, K]."""
    if count := int(is_clipped.any(axis=1).sum()):
        LOG.warning("%s: %s stores %s; values of %s Gaussians were clipped", path, name, ranges, f"{count:,}")


# Lossless WebP images whose 8-bit RGBA pixels store values.

LOSSLESS = 101  # a quality above 100 selects lossless WebP in OpenCV
MAX_SIDE = 16383  # px, the limit of WebP
BGRA = [2, 1, 0, 3]


def encode_webp(path: Path, pixels: NDArray[np.uint8], width: int) -> bytes:
    """Encode pixels, [n, 4] RGBA, row by row as an image padded with zeros; alpha must be at least 1.

    WebP drops colors where alpha is 0, so the image is decoded to verify it.  Raises OutputError if the result
    differs.
    """
    height = -(-len(pixels) // width)
    image = np.zeros((height * width, 4), np.uint8)
    image[:, 3] = 255
    image[: len(pixels)] = pixels
    bgra = np.ascontiguousarray(image[:, BGRA].reshape(height, width, 4))
    is_encoded, data = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])
    if not is_encoded or not np.array_equal(_decode_rgba(data), image):
        raise OutputError(f"{path}: OpenCV {cv2.__version__} cannot write lossless WebP here; install another version")
    return bytes(data.tobytes())


def decode_webp(path: Path, name: str, data: bytes, min_pixels: int, max_pixels: int) -> NDArray[np.uint8]:
    """Decode a WebP image to pixels, [n, 4] RGBA, row by row.

    Raises DataError for any other format, and, before decoding, if n is below `min_pixels` or above `max_pixels`.
    """
    width, height = webp_size(path, name, data)
    if not min_pixels <= width * height <= max_pixels:
        raise DataError(
            f"{path}: {name} has {width} x {height} px; expected {min_pixels} to {max_pixels} px in total; "
            "export the file again"
        )
    try:
        pixels = _decode_rgba(np.frombuffer(data, np.uint8))
    except (cv2.error, ValueError):
        pixels = np.zeros((0, 4), np.uint8)
    if len(pixels) != width * height:
        raise DataError(f"{path}: {name} cannot be decoded; expected a WebP image; copy or export the file again")
    return pixels


def _decode_rgba(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Decode an image to pixels, [n, 4] RGBA.  Without an alpha channel, alpha is 255; for a damaged image, n is 0."""
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3:
        return np.zeros((0, 4), np.uint8)
    if image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
    return np.ascontiguousarray(image.reshape(-1, 4)[:, BGRA])


def webp_size(path: Path, name: str, data: bytes) -> tuple[int, int]:
    """Return the width and height, px, in the header of a lossless WebP image.  Raises DataError for other data."""
    chunk_type = data[12:16]
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        if chunk_type == b"VP8L":
            bits = struct.unpack_from("<I", data, 21)[0]
            return (bits & 16383) + 1, (bits >> 14 & 16383) + 1
        if chunk_type == b"VP8X":
            sides = (int.from_bytes(data[offset : offset + 3], "little") + 1 for offset in (24, 27))
            return next(sides), next(sides)
    raise DataError(f"{path}: {name} is not a lossless WebP image; export the file again")


# Files that are hashed while they are written.


class HashedFile:
    """A file that is written from start to end, and the SHA-256 of its bytes."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._hash = file, hashlib.sha256()

    def write(self, data: bytes) -> None:
        """Append bytes to the file."""
        self._file.write(data)
        self._hash.update(data)

    @property
    def sha256(self) -> str:
        """The SHA-256 of the bytes written so far, as `sha256sum` prints it."""
        return self._hash.hexdigest()


def write_bytes(path: Path, data: bytes) -> str:
    """Write a file and return its SHA-256.  Raises OutputError."""
    with open_hashed(path) as file:
        file.write(data)
    return file.sha256


@contextmanager
def open_hashed(path: Path) -> Iterator[HashedFile]:
    """Open a file for atomic writing, like `open_atomic`, and hash the written bytes.  Raises OutputError."""
    with open_atomic(path) as file:
        yield HashedFile(file)
