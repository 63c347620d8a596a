"""A layer before an image: the colours of both, the derivatives by the image, and the loss of what the layer covers.

Images are [C, H, W]; what a layer leaves of a pixel, T, is [H, W].  A fourth channel of an image is no colour.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def laid_over(layer: NDArray[Any], left: NDArray[Any], image: NDArray[Any]) -> NDArray[Any]:
    """The colours of a layer, [3, H, W] before black, and an image behind it."""
    return np.concatenate([layer + left * image[:3], image[3:]])


def gradient_behind(left: NDArray[Any], gradient: NDArray[Any]) -> NDArray[Any]:
    """The derivative by the image behind, from that by both."""
    return np.concatenate([left * gradient[:3], gradient[3:]])


def layer_cover(left: NDArray[Any], scale: float) -> tuple[float, NDArray[Any]]:
    """The loss, scale times the sum of 1 - T, and its derivative by T."""
    return scale * float((1 - left).sum()), np.full_like(left, -scale)
