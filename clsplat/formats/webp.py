"""Lossless WebP images of 8-bit RGBA pixels, which hold numbers."""

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, OutputError

LOSSLESS = 101  # OpenCV's quality beyond 100
MAX_SIDE = 16383  # px, of the format
BGRA = [2, 1, 0, 3]


def encode(path: Path, pixels: NDArray[np.uint8], width: int) -> bytes:
    """Return an image of pixels [n, 4], row by row, filled up with zeros; alpha must be 1 at least.

    It is decoded again, for the colour under an alpha of 0 would be lost.  Raises OutputError where that differs.
    """
    height = -(-len(pixels) // width)
    image = np.zeros((height * width, 4), np.uint8)
    image[:, 3] = 255
    image[: len(pixels)] = pixels
    bgra = np.ascontiguousarray(image[:, BGRA].reshape(height, width, 4))
    done, data = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])
    if not done or not np.array_equal(_rgba(data), image):
        raise OutputError(f"{path}: OpenCV {cv2.__version__} writes no lossless WebP here; install another version")
    return bytes(data.tobytes())


def decode(path: Path, name: str, data: bytes, least: int, most: int) -> NDArray[np.uint8]:
    """Return the pixels of an image, [n, 4] RGBA, row by row, where `least` <= n <= `most`.

    Raises DataError for another size, before it is decoded, and for another format.
    """
    width, height = size(path, name, data)
    if not least <= width * height <= most:
        raise DataError(
            f"{path}: {name} has {width} x {height} px; expected {least} at least and {most} at most for the numbers "
            "that it holds: export the file again"
        )
    try:
        pixels = _rgba(np.frombuffer(data, np.uint8))
    except (cv2.error, ValueError):
        pixels = np.zeros((0, 4), np.uint8)
    if len(pixels) != width * height:
        raise DataError(f"{path}: {name} cannot be decoded; expected a WebP image: copy or export the file again")
    return pixels


def _rgba(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Decoded pixels; where all alphas are 255 there may be no fourth channel."""
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3:
        return np.zeros((0, 4), np.uint8)
    if image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
    return np.ascontiguousarray(image.reshape(-1, 4)[:, BGRA])


def size(path: Path, name: str, data: bytes) -> tuple[int, int]:
    """Return width and height that the header declares.  Raises DataError for another format."""
    kind = data[12:16]
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        if kind == b"VP8L":
            bits = struct.unpack_from("<I", data, 21)[0]
            return (bits & 16383) + 1, (bits >> 14 & 16383) + 1
        if kind == b"VP8X":
            sides = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
            return next(sides), next(sides)
    raise DataError(f"{path}: {name} is no lossless WebP image; expected one: export the file again")
