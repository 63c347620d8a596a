"""PSNR and SSIM of two images as in papers: 8 bits a channel, SSIM with an 11 x 11 Gaussian window."""

import math

import numpy as np
from numpy.typing import NDArray

from clsplat.metrics.perceptual import Image, ssim_map

MAX_PSNR = 100.0  # dB, for equal images
Mask = NDArray[np.bool_]


def to_8_bits(image: NDArray[np.generic]) -> Image:
    """Return an image with values in [0, 1] as 8 bits: clamped, rounded to the nearest; uint8 stays as it is.

    Raises ValueError for other values, such as integers of 16 bits.
    """
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"the image has values of type {image.dtype}; expected uint8, or floats in [0, 1]")
    return (np.clip(image.astype(np.float32, copy=False), 0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(image: NDArray[np.generic], photograph: NDArray[np.generic], mask: Mask | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB over all channels of the pixels that count.

    image, photograph: [height, width, 3], uint8, or floats in [0, 1] that are rounded to 8 bits; mask: [height, width].
    Raises ValueError for other values.
    """
    squared = (to_8_bits(image).astype(np.float64) - to_8_bits(photograph)) ** 2
    error = float(np.mean(squared if mask is None else squared[mask])) / 255**2
    return MAX_PSNR if error == 0 else 10 * math.log10(1 / error)


def ssim(image: NDArray[np.generic], photograph: NDArray[np.generic], mask: Mask | None = None) -> float:
    """Return the structural similarity (Wang et al. 2004), the mean over the pixels that count; arguments as psnr."""
    similarity = ssim_map(to_8_bits(image), to_8_bits(photograph))
    return float((similarity if mask is None else similarity[mask]).mean())
