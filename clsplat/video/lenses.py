"""Cameras of the size of a film."""

import math
import re

from clsplat.errors import ConfigError, quoted
from clsplat.scene.camera import Camera

SIDES = 16, 8192  # px of a picture's side, least and most
MAX_FRAMES = 100_000
RATES = 1, 240  # frames a second
Size = tuple[int, int]  # width, height


def checked_size(size: str | Size) -> Size:
    """Return the size of a film, given as text such as 640x480 or as numbers.

    Raises ConfigError unless both are even, as codecs need them, and in bounds.
    """
    if isinstance(size, str):
        found = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", size.strip().lower())
        pair = (int(found[1]), int(found[2])) if found else None
    else:
        pair = (size[0], size[1]) if len(size) == 2 and all(isinstance(side, int) for side in size) else None
    if pair is None or not SIDES[0] <= min(pair) <= max(pair) <= SIDES[1] or pair[0] % 2 or pair[1] % 2:
        raise ConfigError(
            f"size {quoted(size)}: expected WIDTHxHEIGHT in even numbers from {SIDES[0]} to {SIDES[1]}, such as 640x480"
        )
    return pair


def size_of(text: str) -> str:
    """Return a size as it is.  Raises ValueError, as a validator does, where no film has it."""
    try:
        checked_size(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return text


def checked_frames(frames: int) -> int:
    """Return a number of frames.  Raises ConfigError where it is out of bounds."""
    if isinstance(frames, bool) or not isinstance(frames, int) or not 1 <= frames <= MAX_FRAMES:
        raise ConfigError(f"frames {quoted(frames)}: expected a whole number from 1 to {MAX_FRAMES}")
    return frames


def checked_rate(fps: float) -> float:
    """Return a number of frames a second.  Raises ConfigError where it is out of bounds."""
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not RATES[0] <= fps <= RATES[1]:
        raise ConfigError(f"fps {quoted(fps)}: expected frames a second from {RATES[0]} to {RATES[1]}")
    return fps


def even_size(camera: Camera) -> Size:
    """Return the size of a camera's image, a pixel less where it is odd, inside the bounds of a film."""
    shrink = min(1.0, SIDES[1] / max(camera.width, camera.height))
    width, height = (max(SIDES[0], int(side * shrink) // 2 * 2) for side in (camera.width, camera.height))
    return width, height


def like(camera: Camera, size: Size) -> Camera:
    """Return a camera of another size that sees as much: its image shows as large an area, with the middle amid it."""
    width, height = size
    scale = math.sqrt(width * height / (camera.width * camera.height))
    return Camera(width, height, camera.fx * scale, camera.fy * scale, width / 2, height / 2)


def around(camera: Camera, size: Size) -> Camera:
    """Return a camera of another size whose image holds all of a camera's, in its middle."""
    return placed(camera, size, fit(camera, size))


def placed(camera: Camera, size: Size, scale: float) -> Camera:
    """Return a camera of another size whose image has a camera's, larger by a factor, in its middle."""
    width, height = size
    left, top = (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
    return Camera(
        width, height, camera.fx * scale, camera.fy * scale, scale * camera.cx + left, scale * camera.cy + top
    )


def fit(camera: Camera, size: Size) -> float:
    """Return the factor by which a camera's image just fits into another size."""
    return min(size[0] / camera.width, size[1] / camera.height)
