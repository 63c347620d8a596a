"""A Gaussian blur of the pixels that count, one place of the window at a time."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def blurred(image: NDArray[Any], sigma: float, mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Mean by the weights of a Gaussian, within 3 sigma along each axis.  image: [3, H, W]; mask: [H, W]; sigma: px."""
    return averaged(image, math.ceil(3 * sigma), 1 / (2 * sigma * sigma), mask)


def averaged(image: NDArray[Any], reach: int, falloff: float, mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Mean, by weights exp(-falloff d²), of the pixels that count within `reach`; where none does, the pixel itself.

    image: [3, H, W]; mask: [H, W] bool; reach: px along each axis; falloff: px⁻².
    """
    _, height, width = image.shape
    counts = np.ones((height, width)) if mask is None else mask.astype(np.float64)
    sums, weights = np.zeros((3, height, width)), np.zeros((height, width))
    for y in range(-min(reach, height - 1), min(reach, height - 1) + 1):
        for x in range(-min(reach, width - 1), min(reach, width - 1) + 1):
            weight = math.exp(-falloff * (x * x + y * y))
            to = np.s_[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
            at = np.s_[max(0, y) : height - max(0, -y), max(0, x) : width - max(0, -x)]
            sums[:, *to] += weight * counts[at] * image[:, *at]
            weights[to] += weight * counts[at]
    return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), image)
