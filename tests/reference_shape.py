"""The oracle, last part: penalties on the shapes of Gaussians in float64 NumPy, with their gradients by log_scales."""

import numpy as np


def covariance_trace(log_scales: np.ndarray, above: np.ndarray | float, extent: float) -> tuple[float, np.ndarray]:
    """Mean of max(sum of squared scales - above, 0) by extent².  log_scales: [N, 3]; above: scene units²."""
    scale2 = np.exp(2 * log_scales)
    excess = scale2.sum(axis=1) - above
    penalised = (excess > 0)[:, None]
    return np.maximum(excess, 0).mean() / extent**2, 2 * scale2 * penalised / len(scale2) / extent**2


def anisotropy(log_scales: np.ndarray, above: float) -> tuple[float, np.ndarray]:
    """Mean of max(longest / shortest axis - above, 0)."""
    rows = np.arange(len(log_scales))
    longest, shortest = log_scales.argmax(axis=1), log_scales.argmin(axis=1)
    ratio = np.exp(log_scales[rows, longest] - log_scales[rows, shortest])
    slope = np.where(ratio > above, ratio, 0) / len(rows)
    gradient = np.zeros_like(log_scales)
    gradient[rows, longest] += slope
    gradient[rows, shortest] -= slope
    return np.maximum(ratio - above, 0).mean(), gradient
