"""The files of a dataset: allowed paths, bytes and images."""

import logging
import os
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted, shortened
from clsplat.files import atomic
from clsplat.reading import opened, read_file
from clsplat.scene.image_headers import HEAD_SIZE, JPEG, TAIL_SIZE, Header, is_cut, parse_header
from clsplat.scene.png import pixels_only

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # its lines name no file; errors here do
logger = logging.getLogger("clsplat")
Missing = Literal["refuse", "skip"]  # what to do about photographs that a dataset names and does not have
MAX_BYTES = (1 << 31) - 1  # of an image file: OpenCV decodes no longer ones
REDUCED = {  # what OpenCV decodes to grey, by the divisor of the size
    1: cv2.IMREAD_GRAYSCALE,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})  # in lower case


def is_image(path: PurePath) -> bool:
    """Return whether a file name has the suffix of an image."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def write_image(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write [H, W, 3] RGB as PNG, creating the folders above it.  Raises OutputError when that fails."""
    assert rgb.dtype == np.uint8, rgb.dtype
    assert rgb.shape[2:] == (3,), rgb.shape
    _, encoded = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    with atomic(path) as file:
        file.write(encoded.tobytes())


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image file in pixels.  Raises DataError when it cannot be read."""
    height, width = read_image(path).shape[:2]
    return width, height


def inside(folder: Path, name: str, where: str) -> Path:
    """Return `folder / name`.  Raises DataError, starting with `where`, when that lies outside the folder."""
    path = PureWindowsPath(name)  # splits at both kinds of slash and at drives
    if path.anchor or ".." in path.parts or not path.parts or any(letter < " " for letter in name):
        raise DataError(f"{where}: the file name {quoted(name)} is not a path below {folder}; rename it")
    return folder / name


def require_files(path: Path, files: Iterable[Path]) -> None:
    """Raise DataError, naming the first few, when some of the `files` of the dataset at `path` do not exist."""
    present(path, list(files), "refuse", "")


def present(
    path: Path, files: Sequence[Path], missing: Missing, remedy: str = ", or --set scene.missing=skip to do without"
) -> list[bool]:
    """Return which of the photographs of the dataset at `path` exist.

    Raises DataError, naming the first few, where some do not, unless those are to be skipped; where none does, always.
    """
    found = [os.path.exists(file) for file in files]  # unlike Path.exists, never raises
    lost = [str(file) for file, there in zip(files, found, strict=True) if not there]
    if lost:
        names = ", ".join(map(shortened, lost[:3])) + (", ..." if len(lost) > 3 else "")
        fault = f"{path}: {len(lost)} of {len(files)} image files are missing: {names}"
        if missing == "refuse" or len(lost) == len(files):
            raise DataError(f"{fault}; put them back{remedy if len(lost) < len(files) else ''}")
        logger.warning("%s; the scene is read without them", fault)
    return found


def read_header(path: Path) -> Header:
    """Return the header of an image file; formats but PNG and JPEG are decoded.  Raises DataError."""
    with opened(path, "an image", limit=MAX_BYTES) as file:
        head = file.read(HEAD_SIZE)
        file.seek(max(0, file.seek(0, 2) - TAIL_SIZE))
        tail = file.read(TAIL_SIZE)
    return parse_header(head, tail, lambda: read_file(path, "an image", limit=MAX_BYTES)) or Header(*image_size(path))


def read_image(path: Path, upright: bool = False) -> NDArray[Any]:
    """Decode an image file to RGB or RGBA, [H, W, 3 or 4], uint8 or uint16; `upright` rotates it by its EXIF tag."""
    return decode_image(read_file(path, "an image", limit=MAX_BYTES), path, upright)


def read_grey(path: Path, long_side: int) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return a photograph as stored in grey, [H, W], no side longer than `long_side` px, and the stored px of one px.

    A JPEG decoder makes half, a quarter or an eighth of the size for less.  Raises DataError as decode_image does.
    """
    data = read_file(path, "an image", limit=MAX_BYTES)
    header = parse_header(data[:HEAD_SIZE], data[-TAIL_SIZE:], lambda: data) if data.startswith(JPEG) else None
    longest = max(header.width, header.height) if header else 0
    half = next((n for n in (8, 4, 2) if longest >= n * long_side), 1)
    pixels = _decoded(data, path, REDUCED[half] | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = pixels.shape[:2]
    shrink = max(1.0, max(height, width) / long_side)
    size = max(1, round(width / shrink)), max(1, round(height / shrink))
    if size != (width, height):
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return np.asarray(pixels, np.uint8), (half * width / size[0], half * height / size[1])


def decode_image(data: bytes, path: Path, upright: bool = False) -> NDArray[Any]:
    """Decode the bytes of the image file `path`, as read_image does.  Raises DataError when they are damaged."""
    pixels = _decoded(data, path, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH if upright else cv2.IMREAD_UNCHANGED)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: {pixels.dtype} pixels; expected 8 or 16 bits per channel: convert it to PNG")
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])  # OpenCV decodes to BGR


def _decoded(data: bytes, path: Path, flags: int) -> NDArray[Any]:
    if is_cut(data):  # some versions of OpenCV fill the rest with grey
        raise DataError(f"{path}: the end of the file is missing; copy it again")
    pixels, fault = None, ""
    try:  # not cv2.imread: that needs ASCII paths on Windows
        pixels = cv2.imdecode(np.frombuffer(pixels_only(data), np.uint8), flags)
    except ValueError as error:
        fault = f" ({error})"
    except cv2.error:
        pass
    if pixels is None:
        raise DataError(f"{path}: not an image, or a damaged one{fault}; copy or export it again")
    return np.asarray(pixels)
