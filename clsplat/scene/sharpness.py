"""How sharp a photograph is, by its small details."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.images import read_grey

BLURRED = 0.25  # share of the middle sharpness of a set: real ones have 0.5 and more, a blur of 1 px leaves 0.08
SIDE = 480  # px: sharpness is measured at this size: at full size, noise counts as detail


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an image [H, W], grey levels²."""
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def sharpness_of(path: Path) -> float:
    """Return the sharpness of a photograph, reduced to SIDE px.  Raises DataError when it cannot be read."""
    return sharpness(read_grey(path, SIDE)[0])
