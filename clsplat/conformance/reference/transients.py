"""Residuals of an image, how many there are of each size, and the pixels that count without the large ones.

Images are [3, H, W], masks and residuals [H, W].
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS, LEAST = 96, 2.0**-12  # eighths of octaves, up to 1


def residuals(image: NDArray[Any], photograph: NDArray[Any]) -> NDArray[Any]:
    """The mean over the channels of the absolute difference."""
    return np.asarray(np.abs(image - photograph).mean(axis=0))


def residual_numbers(values: NDArray[Any]) -> NDArray[np.int64]:
    """The number of residuals by bin: an octave is cut in eight parts of one width."""
    found = np.zeros(BINS, np.int64)
    for value in values.ravel():
        octave = math.floor(math.log2(value / LEAST)) if value > 0 else -1
        part = math.floor((value / (LEAST * 2.0**octave) - 1) * 8)
        found[min(max(8 * octave + part, 0), BINS - 1)] += 1
    return found


def without_transients(
    values: NDArray[Any], counted: NDArray[np.bool_], threshold: float, reach: int
) -> NDArray[np.bool_]:
    """Which pixels count: those below the threshold, and those whose box has at least as many below it as not."""
    found = counted & (values < threshold)
    below = found.copy()
    for y, x in zip(*np.nonzero(counted & ~below), strict=True):
        box = np.s_[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        found[y, x] = 2 * below[box].sum() >= counted[box].sum()
    return found
