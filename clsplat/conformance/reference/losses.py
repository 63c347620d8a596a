"""Image losses and metrics, with gradients by x.

Images are [C,H,W]: x is the render, y the target.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def l1(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Mean absolute difference, and its gradient."""
    return np.mean(np.abs(x - y)), np.sign(x - y) / x.size


def view_error(gradient: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> float:
    """Sum of |gradient (x - y)|, the gradient by x of any losses."""
    return float(np.abs(gradient * (x - y)).sum())


def l2(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Mean squared difference, and its gradient."""
    return np.mean((x - y) ** 2), 2 * (x - y) / x.size


def psnr(x: NDArray[Any], y: NDArray[Any]) -> float:
    """Peak signal-to-noise ratio of images in [0, 1], in dB."""
    return 10 * np.log10(1 / np.mean((x - y) ** 2))


def ssim_taps() -> NDArray[Any]:
    """The 11 weights of the window, which sum to one."""
    weights = np.exp(-(np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) ** 2) / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def window_mean(image: NDArray[Any]) -> NDArray[Any]:
    """Weighted mean over 11x11 pixels, zeros outside the image: one term per offset."""
    taps = ssim_taps()
    _, height, width = image.shape
    padded = np.pad(image, ((0, 0), (SSIM_RADIUS, SSIM_RADIUS), (SSIM_RADIUS, SSIM_RADIUS)))
    total = np.zeros(image.shape)
    for row, weight_y in enumerate(taps):
        for column, weight_x in enumerate(taps):
            total += weight_y * weight_x * padded[:, row : row + height, column : column + width]
    return total


def _ssim_terms(x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """μ1, μ2, a1, a2, b1, b2."""
    mu1, mu2 = window_mean(x), window_mean(y)
    variance1 = window_mean(x * x) - mu1**2
    variance2 = window_mean(y * y) - mu2**2
    covariance = window_mean(x * y) - mu1 * mu2
    a1, a2 = 2 * mu1 * mu2 + C1, 2 * covariance + C2
    b1, b2 = mu1**2 + mu2**2 + C1, variance1 + variance2 + C2
    return mu1, mu2, a1, a2, b1, b2


def ssim_map(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """SSIM of every pixel and channel: [C,H,W]."""
    _, _, a1, a2, b1, b2 = _ssim_terms(x, y)
    return a1 * a2 / (b1 * b2)


def dssim(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """1 - mean SSIM, and its gradient."""
    mu1, mu2, a1, a2, b1, b2 = _ssim_terms(x, y)
    m = a1 * a2 / (b1 * b2)
    d_mu = 2 * mu2 * (a2 - a1) / (b1 * b2) - 2 * mu1 * m * (1 / b1 - 1 / b2)
    d_variance = -m / b2
    d_covariance = 2 * a1 / (b1 * b2)
    g = -1 / x.size
    grad = window_mean(g * d_mu) + 2 * x * window_mean(g * d_variance) + y * window_mean(g * d_covariance)
    return 1 - np.mean(m), grad


def ms_ssim(x: NDArray[Any], y: NDArray[Any], scales: int) -> float:
    """MS-SSIM (Wang et al. 2003) over whole windows only, weights divided by their sum: one window at a time."""
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
