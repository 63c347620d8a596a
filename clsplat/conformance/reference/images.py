"""Compute image losses and metrics, their gradients with respect to x, and the fusion of depth images.

Images are [C, H, W]: x is the render, y the photograph.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.types import PinholeCamera

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def l1(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return the mean absolute difference, and its gradient."""
    return np.mean(np.abs(x - y)), np.sign(x - y) / x.size


def view_error(gradient: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> float:
    """Return the sum of |gradient * (x - y)|.  gradient: the gradient of the losses with respect to x."""
    return float(np.abs(gradient * (x - y)).sum())


def l2(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return the mean squared difference, and its gradient."""
    return np.mean((x - y) ** 2), 2 * (x - y) / x.size


def psnr(x: NDArray[Any], y: NDArray[Any]) -> float:
    """Return the peak signal-to-noise ratio of images in [0, 1], in dB."""
    return 10 * np.log10(1 / np.mean((x - y) ** 2))


def ssim_taps() -> NDArray[Any]:
    """Return the 11 weights of the window, whose sum is 1."""
    weights = np.exp(-(np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) ** 2) / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def window_mean(image: NDArray[Any]) -> NDArray[Any]:
    """Return the weighted mean over 11 x 11 pixels, with zeros outside the image, as a sum over offsets."""
    taps = ssim_taps()
    _, height, width = image.shape
    padded = np.pad(image, ((0, 0), (SSIM_RADIUS, SSIM_RADIUS), (SSIM_RADIUS, SSIM_RADIUS)))
    total = np.zeros(image.shape)
    for row, weight_y in enumerate(taps):
        for column, weight_x in enumerate(taps):
            total += weight_y * weight_x * padded[:, row : row + height, column : column + width]
    return total


def _ssim_terms(x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return the terms of the SSIM: the means μ1 and μ2, numerators a1 and a2, and denominators b1 and b2."""
    mu1, mu2 = window_mean(x), window_mean(y)
    variance1 = window_mean(x * x) - mu1**2
    variance2 = window_mean(y * y) - mu2**2
    covariance = window_mean(x * y) - mu1 * mu2
    a1, a2 = 2 * mu1 * mu2 + C1, 2 * covariance + C2
    b1, b2 = mu1**2 + mu2**2 + C1, variance1 + variance2 + C2
    return mu1, mu2, a1, a2, b1, b2


def ssim_map(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """Return the SSIM of every pixel and channel, [C,H,W]."""
    _, _, a1, a2, b1, b2 = _ssim_terms(x, y)
    return a1 * a2 / (b1 * b2)


def dssim(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return 1 - mean SSIM, and its gradient."""
    mu1, mu2, a1, a2, b1, b2 = _ssim_terms(x, y)
    m = a1 * a2 / (b1 * b2)
    d_mu = 2 * mu2 * (a2 - a1) / (b1 * b2) - 2 * mu1 * m * (1 / b1 - 1 / b2)
    d_variance = -m / b2
    d_covariance = 2 * a1 / (b1 * b2)
    g = -1 / x.size
    grad = window_mean(g * d_mu) + 2 * x * window_mean(g * d_variance) + y * window_mean(g * d_covariance)
    return 1 - np.mean(m), grad


def ms_ssim(x: NDArray[Any], y: NDArray[Any], scales: int) -> float:
    """Return MS-SSIM (Wang et al. 2003) over complete windows, with weights normalized to a sum of 1."""
    weights = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])[:scales]
    window = np.outer(ssim_taps(), ssim_taps())
    channels, products = len(x), np.ones(len(x))
    for scale, weight in enumerate(weights / weights.sum()):
        height, width = x.shape[1:]
        luminance, structure = [], []
        for row in range(height - 10):
            for column in range(width - 10):
                a, b = (image[:, row : row + 11, column : column + 11] for image in (x, y))
                mu1, mu2 = (a * window).sum((1, 2)), (b * window).sum((1, 2))
                d1, d2 = a - mu1[:, None, None], b - mu2[:, None, None]
                variance1, variance2 = (d1 * d1 * window).sum((1, 2)), (d2 * d2 * window).sum((1, 2))
                covariance = (d1 * d2 * window).sum((1, 2))
                luminance.append((2 * mu1 * mu2 + C1) / (mu1**2 + mu2**2 + C1))
                structure.append((2 * covariance + C2) / (variance1 + variance2 + C2))
        terms = np.array(structure) * (np.array(luminance) if scale == scales - 1 else 1)
        products *= np.maximum(terms.mean(axis=0), 0) ** weight
        x, y = (
            image[:, : height // 2 * 2, : width // 2 * 2].reshape(channels, height // 2, 2, width // 2, 2).mean((2, 4))
            for image in (x, y)
        )
    return float(products.mean())


# A Gaussian blur of unmasked pixels, as a sum over offsets.


def blur(image: NDArray[Any], sigma: float, mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Return Gaussian-weighted means within 3 sigma along each axis.  image: [3, H, W]; mask: [H, W]; sigma: px."""
    return masked_mean(image, math.ceil(3 * sigma), 1 / (2 * sigma * sigma), mask)


def masked_mean(image: NDArray[Any], reach: int, falloff: float, mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Return means of the unmasked pixels within `reach`, weighted by exp(-falloff d²), [3, H, W].

    A pixel without unmasked pixels in reach is unchanged.  image: [3, H, W]; mask: [H, W] bool; reach: px along each
    axis; falloff: px⁻².
    """
    _, height, width = image.shape
    counts = np.ones((height, width)) if mask is None else mask.astype(np.float64)
    sums, weights = np.zeros((3, height, width)), np.zeros((height, width))
    for y in range(-min(reach, height - 1), min(reach, height - 1) + 1):
        for x in range(-min(reach, width - 1), min(reach, width - 1) + 1):
            weight = math.exp(-falloff * (x * x + y * y))
            target = np.s_[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
            source = np.s_[max(0, y) : height - max(0, -y), max(0, x) : width - max(0, -x)]
            sums[:, *target] += weight * counts[source] * image[:, *source]
            weights[target] += weight * counts[source]
    return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), image)


# One level of the Haar transform and its inverse, with a separate high-pass analysis filter, as matrix products.

LOW_PASS, HIGH_PASS = np.array([1.0, 1.0]) / np.sqrt(2), np.array([1.0, -1.0]) / np.sqrt(2)


def analysis_and_synthesis(length: int, taps: NDArray[Any]) -> NDArray[Any]:
    """Return the matrix, [length, length], of an analysis with high-pass filter `taps` and a Haar synthesis."""
    analysis, synthesis = np.zeros((length, length)), np.zeros((length, length))
    for pair in range(length // 2):
        columns = slice(2 * pair, 2 * pair + 2)
        analysis[pair, columns], analysis[length // 2 + pair, columns] = LOW_PASS, taps
        synthesis[columns, pair], synthesis[columns, length // 2 + pair] = LOW_PASS, HIGH_PASS
    return synthesis @ analysis


def haar_filter(image: NDArray[Any], taps: NDArray[Any], mask: NDArray[Any] | None = None) -> NDArray[Any]:
    """Analyze and synthesize an image along both axes.

    Images of odd size are padded with their last row or column.  Masked pixels are replaced with the mean of the
    unmasked pixels in their 2 x 2 block, if there are any.  image: [3, H, W]; taps: [2]; mask: [H, W] bool.
    """
    _, height, width = image.shape
    odd = ((0, height % 2), (0, width % 2))
    padded = np.pad(image, ((0, 0), *odd), mode="edge")
    counts = np.pad(np.ones((height, width), bool) if mask is None else mask, odd, mode="edge")
    for row in range(0, padded.shape[1], 2):
        for column in range(0, padded.shape[2], 2):
            block = np.s_[row : row + 2, column : column + 2]
            if counts[block].any():
                padded[:, *block][:, ~counts[block]] = padded[:, *block][:, counts[block]].mean(axis=1, keepdims=True)
    down, across = (analysis_and_synthesis(length, taps) for length in padded.shape[1:])
    return np.asarray(down @ padded @ across.T)[:, :height, :width]


def haar_gradient(
    image: NDArray[Any], gradient: NDArray[Any], taps: NDArray[Any], mask: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Return the gradient of sum(gradient * filtered image) with respect to the taps, [2].

    The image is a quadratic function of each tap, so central differences are exact for any step size.
    """
    slopes = [(haar_filter(image, taps + e, mask) - haar_filter(image, taps - e, mask)) / 2 for e in np.eye(2)]
    return np.array([(gradient * slope).sum() for slope in slopes])


# Residuals of an image, their histogram, and a mask that excludes large residuals.

BINS, MIN_RESIDUAL = 96, 2.0**-12  # eighths of octaves, up to 1


def residuals(image: NDArray[Any], photograph: NDArray[Any]) -> NDArray[Any]:
    """Return the absolute difference, averaged over channels, [H, W]."""
    return np.asarray(np.abs(image - photograph).mean(axis=0))


def residual_histogram(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return the number of residuals per bin, [BINS]; each octave has eight bins of equal width."""
    histogram = np.zeros(BINS, np.int64)
    for value in values.ravel():
        octave = math.floor(math.log2(value / MIN_RESIDUAL)) if value > 0 else -1
        eighth = math.floor((value / (MIN_RESIDUAL * 2.0**octave) - 1) * 8)
        histogram[min(max(8 * octave + eighth, 0), BINS - 1)] += 1
    return histogram


def mask_transients(
    values: NDArray[Any], unmasked: NDArray[np.bool_], threshold: float, reach: int
) -> NDArray[np.bool_]:
    """Return a mask, [H, W], of the pixels that are not transient.

    A pixel is transient if its residual, and more than half of the residuals in the box around it, reach the threshold.
    """
    mask = unmasked & (values < threshold)
    is_below = mask.copy()
    for y, x in zip(*np.nonzero(unmasked & ~is_below), strict=True):
        box = np.s_[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        mask[y, x] = 2 * is_below[box].sum() >= unmasked[box].sum()
    return mask


# Fusion of depth images at points: signed distances to the surface, and views of free space.


def project_points(points: NDArray[Any], camera: PinholeCamera) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the image positions, [P, 2] px, the depths, [P], and a mask of the points that the camera shows, [P]."""
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    safe = np.where(z > 0, z, 1)
    u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    return np.stack([u, v], axis=1), z, (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)


def integrate_view(
    points: NDArray[Any], pixels: NDArray[Any], camera: PinholeCamera, truncation: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return what a view adds to the sums at each point, [6, P], and the point's margin, [P].

    A view that sees the point adds the point's signed distance to the surface, as a fraction of `truncation`, and 1;
    near the surface, it also adds red, green, blue, and 1.  The margin is the smallest distance of a value to a
    threshold, in px or as a fraction of `truncation`.  pixels: [H, W, 4], colors and depth.
    """
    position, z, is_shown = project_points(points, camera)
    sums, margin = np.zeros((6, len(points))), np.abs(2 * position - np.rint(2 * position)).min(axis=1) / 2
    for i in np.flatnonzero(is_shown):
        u, v = position[i]
        color, depth = pixels[int(v), int(u), :3], pixels[int(v), int(u), 3]
        column, row = math.floor(u - 0.5), math.floor(v - 0.5)
        around = pixels[row : row + 2, column : column + 2, 3] if min(row, column) >= 0 else np.zeros((0, 0))
        if around.shape == (2, 2) and around.min() > 0:
            step = (around.max() - around.min()) / truncation
            margin[i] = min(margin[i], abs(step - 1))
            right, down = u - 0.5 - column, v - 0.5 - row
            between = np.array([1 - down, down]) @ around @ np.array([1 - right, right])
            depth = between if step < 1 else depth
        distance = (depth - z[i]) / truncation
        margin[i] = min(margin[i], abs(distance - 1), abs(distance + 1))
        if depth > 0 and distance >= -1:
            sums[:2, i] = min(distance, 1), 1
            if distance < 1:
                sums[2:, i] = *color, 1
    return sums, margin


def sees_free(points: NDArray[Any], depths: NDArray[Any], camera: PinholeCamera, voxel: float) -> NDArray[np.bool_]:
    """Return a mask of the points that are in front of the surface of a view, [P], by at least a voxel."""
    position, z, is_shown = project_points(points, camera)
    column, row = np.where(is_shown[:, None], position, 0).astype(int).T
    return np.asarray(is_shown & (depths[row, column] - z >= voxel))
