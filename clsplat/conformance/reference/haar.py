"""One level of the Haar transform and back, with a high-pass analysis filter of its own: matrices of whole lines."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

LOW, HIGH = np.array([1.0, 1.0]) / np.sqrt(2), np.array([1.0, -1.0]) / np.sqrt(2)


def analysis_and_synthesis(length: int, taps: NDArray[Any]) -> NDArray[Any]:
    """The matrix [length, length] of analysis with the high-pass filter `taps`, then synthesis with Haar's filters."""
    there, back = np.zeros((length, length)), np.zeros((length, length))
    for pair in range(length // 2):
        at = slice(2 * pair, 2 * pair + 2)
        there[pair, at], there[length // 2 + pair, at] = LOW, taps
        back[at, pair], back[at, length // 2 + pair] = LOW, HIGH
    return back @ there


def haar_filtered(image: NDArray[Any], taps: NDArray[Any], mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Analysis and synthesis along both axes; odd sizes repeat the last line, masked pixels are their block's mean.

    image: [3, H, W]; taps: [2]; mask: [H, W] bool.
    """
    _, height, width = image.shape
    odd = ((0, height % 2), (0, width % 2))
    whole = np.pad(image, ((0, 0), *odd), mode="edge")
    counts = np.pad(np.ones((height, width), bool) if mask is None else mask, odd, mode="edge")
    for row in range(0, whole.shape[1], 2):
        for column in range(0, whole.shape[2], 2):
            at = np.s_[row : row + 2, column : column + 2]
            if counts[at].any():
                whole[:, *at][:, ~counts[at]] = whole[:, *at][:, counts[at]].mean(axis=1, keepdims=True)
    down, across = (analysis_and_synthesis(length, taps) for length in whole.shape[1:])
    return np.asarray(down @ whole @ across.T)[:, :height, :width]


def haar_gradient(
    image: NDArray[Any], gradient: NDArray[Any], taps: NDArray[Any], mask: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Derivatives of sum(gradient * filtered image) by the taps, [2].

    The image is a square in each tap, so that a difference about its middle is exact at any distance.
    """
    both = [(haar_filtered(image, taps + e, mask) - haar_filtered(image, taps - e, mask)) / 2 for e in np.eye(2)]
    return np.array([(gradient * one).sum() for one in both])
