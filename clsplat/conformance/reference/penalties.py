"""Penalties on scales and opacities, with their gradients by log_scales and logit_opacity."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def covariance_trace(
    log_scales: NDArray[Any], above: NDArray[Any] | float, extent: float
) -> tuple[float, NDArray[Any]]:
    """Mean of max(sum of squared scales - above, 0) by extent².  log_scales: [N, 3]; above: scene units²."""
    scale2 = np.exp(2 * log_scales)
    excess = scale2.sum(axis=1) - above
    penalised = (excess > 0)[:, None]
    return np.maximum(excess, 0).mean() / extent**2, 2 * scale2 * penalised / len(scale2) / extent**2


def anisotropy(log_scales: NDArray[Any], above: float) -> tuple[float, NDArray[Any]]:
    """Mean of max(longest / shortest axis - above, 0)."""
    rows = np.arange(len(log_scales))
    longest, shortest = log_scales.argmax(axis=1), log_scales.argmin(axis=1)
    ratio = np.exp(log_scales[rows, longest] - log_scales[rows, shortest])
    slope = np.where(ratio > above, ratio, 0) / len(rows)
    gradient = np.zeros_like(log_scales)
    gradient[rows, longest] += slope
    gradient[rows, shortest] -= slope
    return np.maximum(ratio - above, 0).mean(), gradient


def mean_scale(log_scales: NDArray[Any], extent: float) -> tuple[float, NDArray[Any]]:
    """Mean of the scales by extent.  log_scales: [N, 3]."""
    scales = np.exp(log_scales)
    return scales.mean() / extent, scales / scales.size / extent


def mean_opacity(logit_opacity: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Mean of the opacities.  logit_opacity: [N, 1]."""
    opacities = 1 / (1 + np.exp(-logit_opacity))
    return opacities.mean(), opacities * (1 - opacities) / opacities.size
