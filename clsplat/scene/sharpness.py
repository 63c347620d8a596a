"""How sharp a photograph is, by its small details."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.images import read_grey

BLURRED = 0.25  # share of the middle of a set: six captures have 0.4 and more, a blur of 1 px leaves 0.05 to 0.09
SIDE = 480  # px: sharpness is measured at this size: at full size, noise counts as detail


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an image [H, W], grey levels²."""
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def both_sharpnesses(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the sharpness of an image [H, W], and it by the square of its mean, which a darker copy has too, [2]."""
    found = sharpness(grey)
    return np.array([found, found / max(float(grey.mean()), 1.0) ** 2])


def sharpness_of(path: Path) -> NDArray[np.float64]:
    """Return both sharpnesses of a photograph, reduced to SIDE px.  Raises DataError when it cannot be read."""
    return both_sharpnesses(read_grey(path, SIDE)[0])


def is_blurred(own: NDArray[np.float64], middle: NDArray[np.float64]) -> bool:
    """Return whether both sharpnesses of a photograph are far below the medians of a set, [2].

    The first alone is small of a dark photograph, the second of a bright one among dark ones.
    """
    return bool((own < BLURRED * middle).all())
