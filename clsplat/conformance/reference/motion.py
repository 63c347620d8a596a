"""Compute moving Gaussians at a timestamp and the gradient of their motion, one Gaussian after another.

A row of motion contains the velocity [3], time center, and log of the duration; the acceleration [3] and jerk [3] for
degree 2 or 3; and the time derivative of the quaternion [4] if Gaussians rotate.  See FreeTimeGS (Wang et al.
2025) and Spacetime Gaussians (Li et al. 2024).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

PRESENCE_MIN = 1 / 255


def coefficients(row: NDArray[Any], degree: int) -> list[NDArray[Any]]:
    """Return the coefficients b_1, b_2, …, [3] each, of the polynomial in a row of motion."""
    return [row[0:3], row[5:8], row[8:11]][:degree]


def presence(row: NDArray[Any], time: float) -> float:
    """Return the factor on the opacity at a time."""
    distance = (time - row[3]) / np.exp(row[4])
    return float(np.exp(-0.5 * distance**2))


def move_gaussians(
    motion: NDArray[Any],
    means: NDArray[Any],
    quats: NDArray[Any],
    logit_opacity: NDArray[Any],
    time: float,
    degree: int,
    has_rotation: bool,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return means, [N, 3], quaternions, [N, 4], and logits, [N], at a time; absent Gaussians have infinite means.

    has_rotation: whether Gaussians rotate.
    """
    means, quats, logits = means.copy(), quats.copy(), logit_opacity.copy()
    for n, row in enumerate(motion):
        dt, factor = time - row[3], presence(row, time)
        for order, vector in enumerate(coefficients(row, degree), 1):
            means[n] += vector * dt**order
        if has_rotation:
            quats[n] += row[-4:] * dt
        if factor < PRESENCE_MIN:
            means[n] = np.inf
        alpha = factor / (1 + np.exp(-logit_opacity[n]))
        with np.errstate(divide="ignore"):
            logits[n] = np.log(alpha) - np.log1p(-alpha) if factor < 1 else logit_opacity[n]
    return means, quats, logits


def move_gaussians_backward(
    motion: NDArray[Any],
    logit_opacity: NDArray[Any],
    grad_means: NDArray[Any],
    grad_quats: NDArray[Any],
    grad_logit: NDArray[Any],
    time: float,
    degree: int,
    has_rotation: bool,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return dL/d(motion), [N, W], and dL/d(logit_opacity), [N], from the gradients at a time.

    The gradients of means and quaternions at the time are also those at the time center.  They are zero for absent
    Gaussians.
    """
    grad_motion, grad_center = np.zeros_like(motion), np.zeros_like(logit_opacity)
    for n, row in enumerate(motion):
        dt, factor, duration = time - row[3], presence(row, time), np.exp(row[4])
        if factor < PRESENCE_MIN:
            continue
        alpha = 1 / (1 + np.exp(-logit_opacity[n]))
        grad_alpha_t = grad_logit[n] / (alpha * factor * (1 - alpha * factor))
        grad_center[n] = grad_alpha_t * factor * alpha * (1 - alpha)
        grad_factor = grad_alpha_t * alpha
        for order, vector in enumerate(coefficients(row, degree), 1):
            first = (0, 5, 8)[order - 1]
            grad_motion[n, first : first + 3] = grad_means[n] * dt**order
            grad_motion[n, 3] -= order * dt ** (order - 1) * (grad_means[n] @ vector)
        if has_rotation:
            grad_motion[n, -4:] = grad_quats[n] * dt
            grad_motion[n, 3] -= grad_quats[n] @ row[-4:]
        grad_motion[n, 3] += grad_factor * factor * dt / duration**2
        grad_motion[n, 4] = grad_factor * factor * (dt / duration) ** 2
    return grad_motion, grad_center
