"""A Gaussian blur of the pixels that count, one place of the window at a time."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def blurred(image: NDArray[Any], sigma: float, mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Mean by weight of the pixels that count within 3 sigma along each axis; where none does, the pixel itself.

    image: [3, H, W]; mask: [H, W] bool; sigma: px.
    """
    _, height, width = image.shape
    counts = np.ones((height, width)) if mask is None else mask.astype(np.float64)
    reach = math.ceil(3 * sigma)
    sums, weights = np.zeros((3, height, width)), np.zeros((height, width))
    for y in range(-min(reach, height - 1), min(reach, height - 1) + 1):
        for x in range(-min(reach, width - 1), min(reach, width - 1) + 1):
            weight = math.exp(-(x * x + y * y) / (2 * sigma * sigma))
            to = np.s_[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
            at = np.s_[max(0, y) : height - max(0, -y), max(0, x) : width - max(0, -x)]
            sums[:, *to] += weight * counts[at] * image[:, *at]
            weights[to] += weight * counts[at]
    return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), image)
