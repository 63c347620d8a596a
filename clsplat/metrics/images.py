"""Compute PSNR and SSIM as in papers: of 8-bit images, with an 11 x 11 Gaussian window for SSIM."""

import math

import numpy as np
from numpy.typing import NDArray

from clsplat.metrics.perceptual import Image, ssim_map

MAX_PSNR = 100.0  # dB, for equal images
Mask = NDArray[np.bool_]


def to_8_bits(image: NDArray[np.generic]) -> Image:
    """Convert an image with values in [0, 1] to 8 bits: clamp and round to nearest.  uint8 is returned unchanged.

    Raises ValueError for other types, such as 16-bit integers.
    """
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"the image has values of type {image.dtype}; expected uint8, or floats in [0, 1]")
    return (np.clip(image.astype(np.float32, copy=False), 0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(image: NDArray[np.generic], photograph: NDArray[np.generic], mask: Mask | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB over all channels of unmasked pixels.

    image, photograph: [height, width, 3], uint8, or floats in [0, 1] that are rounded to 8 bits.
    mask: [height, width] bool, True for unmasked pixels.
    Raises ValueError for other types, for different shapes, and if all pixels are masked.
    """
    image, photograph = _check(image, photograph, mask)
    squares = (image.astype(np.float64) - photograph) ** 2
    error = float(np.mean(squares if mask is None else squares[mask])) / 255**2
    return MAX_PSNR if error == 0 else 10 * math.log10(1 / error)


def ssim(image: NDArray[np.generic], photograph: NDArray[np.generic], mask: Mask | None = None) -> float:
    """Return the structural similarity (Wang et al. 2004), averaged over unmasked pixels.

    Arguments and errors are as in `psnr`.
    """
    similarity = ssim_map(*_check(image, photograph, mask))
    return float((similarity if mask is None else similarity[mask]).mean())


def _check(image: NDArray[np.generic], photograph: NDArray[np.generic], mask: Mask | None) -> tuple[Image, Image]:
    """Convert both images to 8 bits.  Raises ValueError if they cannot be compared."""
    shape = image.shape
    if shape != photograph.shape or len(shape) != 3 or shape[2] != 3 or image.size == 0:
        raise ValueError(
            f"the image has shape {shape}, the photo {photograph.shape}; "
            "expected the same [height, width, 3], with at least one pixel"
        )
    if mask is not None and (mask.dtype != np.bool_ or mask.shape != shape[:2] or not mask.any()):
        raise ValueError(
            f"the mask has shape {mask.shape} and type {mask.dtype}; "
            f"expected bool of shape {shape[:2]}, with at least one unmasked pixel"
        )
    for name, pixels in (("image", image), ("photo", photograph)):
        if np.issubdtype(pixels.dtype, np.floating) and not np.isfinite(pixels).all():
            raise ValueError(f"the {name} has values that are not finite; expected uint8, or floats in [0, 1]")
    return to_8_bits(image), to_8_bits(photograph)
