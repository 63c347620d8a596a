"""Sharp, evenly spaced frames of a video."""

import logging
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.scene.images import write_image

LOG = logging.getLogger("clsplat")
SHARPNESS_SIDE = 480  # px: sharpness is measured at this size: at full size, noise counts as detail


def write_frames(video: Path, out: Path, frames: int = 100, long_side: int | None = None) -> int:
    """Write the sharpest frame of each of `frames` equal parts of a video as PNG; return their number.

    The format is PNG because a second lossy coding changes features and colours.  Existing frames stay unchanged.
    Raises DataError when the video cannot be decoded.
    """
    LOG.info("%s: looking for sharp frames", video)
    sharpness = [_sharpness(image) for image in _decoded(video)]
    chosen = sharpest(sharpness, frames)
    LOG.info("%d frames, of which %d are written", len(sharpness), len(chosen))
    files = {place: out / f"frame_{i:05d}.png" for i, place in enumerate(chosen, 1)}
    if all(path.is_file() for path in files.values()):
        return len(files)
    for place, image in enumerate(_decoded(video)):
        if place in files and not files[place].is_file():
            write_image(files[place], np.ascontiguousarray(_limited(image, long_side)[:, :, ::-1]))
    return len(files)


def sharpest(sharpness: list[float], parts: int) -> list[int]:
    """Return the index of the largest value in each of `parts` equal parts, the first of equal ones."""
    edges = np.linspace(0, len(sharpness), min(parts, len(sharpness)) + 1).astype(int)
    return [int(a + np.argmax(sharpness[a:b])) for a, b in pairwise(edges)]


def _decoded(video: Path) -> Iterator[NDArray[np.uint8]]:
    """The frames, [H, W, 3] BGR.  Raises DataError when there is none."""
    if not video.is_file():
        raise DataError(f"{video}: no such file; expected a video")
    reader = cv2.VideoCapture(str(video))
    try:
        found = False
        while True:
            good, image = reader.read()
            if not good:
                break
            found = True
            yield np.asarray(image, np.uint8)
    finally:
        reader.release()
    if not found:
        raise DataError(f"{video}: not a video that OpenCV decodes; convert it to MP4 (H.264)")


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of the reduced grey image, grey levels²."""
    grey = cv2.cvtColor(_limited(image, SHARPNESS_SIDE), cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _limited(image: NDArray[np.uint8], long_side: int | None) -> NDArray[np.uint8]:
    """The image with no side longer than `long_side` px."""
    height, width = image.shape[:2]
    factor = max(height, width) / (long_side or max(height, width))
    if factor <= 1:
        return image
    size = max(1, round(width / factor)), max(1, round(height / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
