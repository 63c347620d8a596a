"""The files of a dataset: which paths are allowed, their bytes, and photographs."""

import operator
import os
from collections.abc import Iterable
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.files import atomic
from clsplat.scene.scene import View

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})  # in lower case
BLACK = (0.0, 0.0, 0.0)
MIN_WHITE = 0.99  # of the largest value: a mask that was stored as JPEG is never quite white


def load_image(view: View, background: tuple[float, float, float] | None = None) -> NDArray[np.uint8]:
    """Return the photograph of `view` at its camera's size, RGB, [H, W, 3]; alpha is composited on `background`.

    `background` is a colour in [0, 1], black by default.  Raises DataError when the file cannot be read as an 8- or
    16-bit image, or when it is not the camera's image before downscaling.
    """
    pixels = _as_taken(view, view.image_path)
    width, height = view.camera.width, view.camera.height
    opaque, resized = pixels.shape[2] == 3, pixels.shape[:2] != (height, width)
    if opaque and not resized and pixels.dtype == np.uint8:
        return pixels
    # Double where the reference uses it, to truncate as it does; single saves memory on large photographs.
    values: NDArray[Any] = pixels.astype(np.float32 if opaque else np.float64)
    if resized:  # not premultiplied by alpha: so does the reference (multi-scale Blender)
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    limit = int(np.iinfo(pixels.dtype).max)
    if opaque:
        return np.asarray(np.rint(values * (255 / limit)), np.uint8)
    unit = values / limit
    colour, alpha = unit[:, :, :3], unit[:, :, 3:]
    composite = colour * alpha + np.array(background or BLACK) * (1 - alpha)
    slack = 1e-3 if resized else 0.0  # OpenCV's area weights are single precision: no level may be lost to them
    return np.asarray(composite * 255 + slack, np.uint8)  # truncated: so does the reference (Kerbl et al. 2023)


def load_mask(view: View) -> NDArray[np.bool_] | None:
    """Return which pixels of `load_image` count, [H, W], or None where all do.

    They do where the whole of the pixel is white in the mask file, for alpha as mask opaque in the photograph, and for
    a lens whose whole photograph is wanted, not blank.
    Raises DataError as load_image does.
    """
    layers = []
    if view.mask_path is not None:
        layers.append(_as_taken(view, view.mask_path)[:, :, :1])
    if view.alpha == "mask":
        pixels = _as_taken(view, view.image_path)
        layers += [pixels[:, :, 3:]] if pixels.shape[2] == 4 else []
    if view.lens is not None and view.lens.whole:
        layers.append(np.where(view.lens.shown, 255, 0).astype(np.uint8)[:, :, None])
    size = view.camera.width, view.camera.height
    masks = [
        cv2.resize(layer.astype(np.float32), size, interpolation=cv2.INTER_AREA) > MIN_WHITE * np.iinfo(layer.dtype).max
        for layer in layers
    ]
    return np.logical_and.reduce(masks) if masks else None


def _as_taken(view: View, path: Path) -> NDArray[Any]:
    """The pixels of a file as its camera saw them: upright, undistorted, before downscaling.

    A file that is turned by its EXIF tag is turned where only then it is the camera's image: COLMAP ignores the tag.
    Raises DataError when it is not the camera's image in either case.
    """
    pixels, lens = read_image(path), view.lens
    stored = pixels.shape[1::-1]
    camera = (lens.width, lens.height) if lens else (view.camera.width, view.camera.height)
    fits = operator.eq if lens else _scales_to
    if not fits(stored, camera) and fits(stored[::-1], camera):
        pixels = read_image(path, upright=True)
    width, height = pixels.shape[1::-1]
    if not fits((width, height), camera):
        raise DataError(
            f"{path}: the image is {width}x{height} pixels, its camera {camera[0]}x{camera[1]}; expected the same size"
            f"{'' if lens else ', or a larger image of the same shape'}: use the images the cameras were made from"
        )
    return lens.undistort_image(pixels) if lens else pixels


def is_image(path: PurePath) -> bool:
    """Tell whether a file name has the suffix of an image."""
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


def read_file(path: Path) -> bytes:
    """Return the bytes of a file.  Raises DataError when it cannot be read."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise DataError(f"{path}: cannot read it ({error}); check the path and its permissions") from error


def inside(folder: Path, name: str, where: str) -> Path:
    """Return `folder / name`.  Raises DataError, starting with `where`, when that would lie outside the folder."""
    path = PureWindowsPath(name)  # knows both kinds of slash, and drives
    if path.anchor or ".." in path.parts or not path.parts or any(letter < " " for letter in name):
        raise DataError(f"{where}: the file name {name!r} is not a path below {folder}; rename it")
    return folder / name


def require_files(path: Path, files: Iterable[Path]) -> None:
    """Raise DataError, naming the first few, when some of the `files` of the dataset at `path` do not exist."""
    wanted = list(files)
    missing = [str(file) for file in wanted if not os.path.isfile(file)]  # unlike Path.is_file, never raises
    if missing:
        few = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise DataError(f"{path}: {len(missing)} of {len(wanted)} image files are missing: {few}; put them back")


def read_image(path: Path, upright: bool = False) -> NDArray[Any]:
    """Decode an image file to RGB or RGBA, [H, W, 3 or 4], uint8 or uint16; `upright` turns it by its EXIF tag."""
    data = np.frombuffer(read_file(path), np.uint8)  # not cv2.imread: that needs ASCII paths on Windows
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH if upright else cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise DataError(f"{path}: not an image, or a damaged one; copy or export it again")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise DataError(f"{path}: {pixels.dtype} pixels; expected 8 or 16 bits per channel: convert it to PNG")
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])  # OpenCV decodes to BGR


def fits(view: View, size: tuple[int, int]) -> bool:
    """Tell whether a file of `size` (width, height), turned upright or not, is the image of a view's camera."""
    if view.lens:
        return size == (view.lens.width, view.lens.height)
    return _scales_to(size, (view.camera.width, view.camera.height))


def _scales_to(file: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Tell whether one factor >= 1 takes the size of the file to that of the camera, as Camera.downscaled rounds."""
    smallest = max(1.0, *(f / (c + 0.5) for f, c in zip(file, camera, strict=True)))
    largest = min(f / (c - 0.5) if c > 1 else np.inf for f, c in zip(file, camera, strict=True))
    return smallest <= largest
