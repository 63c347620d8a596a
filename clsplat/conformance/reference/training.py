"""Compute updates of Gaussians between steps: Adam, penalties, density rules, splitting matrices, and cluster means."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.blending import alpha_gradients
from clsplat.conformance.reference.types import PinholeCamera, RawGaussians, Splats, Thresholds


def adam_step(
    parameter: NDArray[Any],
    grad: NDArray[Any],
    moment1: NDArray[Any],
    moment2: NDArray[Any],
    step: int,
    rate: float | NDArray[Any],
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
    mask: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the new parameter and moments (Kingma and Ba 2015), with epsilon outside the root, as in PyTorch.

    step: number of the update, from 1; mask: the rows to update, [N], or None for all.
    """
    first = beta1 * moment1 + (1 - beta1) * grad
    second = beta2 * moment2 + (1 - beta2) * grad**2
    mean = first / (1 - beta1**step)
    square = second / (1 - beta2**step)
    new_parameter = parameter - rate * mean / (np.sqrt(square) + epsilon)
    if mask is None:
        return new_parameter, first, second
    rows = mask.reshape(-1, *[1] * (grad.ndim - 1))
    return np.where(rows, new_parameter, parameter), np.where(rows, first, moment1), np.where(rows, second, moment2)


# Penalties on scales and opacities.  Gradients are with respect to log_scales and logit_opacity.


def covariance_trace(
    log_scales: NDArray[Any], threshold: NDArray[Any] | float, extent: float
) -> tuple[float, NDArray[Any]]:
    """Return the mean of max(sum of squared scales - threshold, 0) / extent², and its gradient.

    log_scales: [N, 3]; threshold: scene units².
    """
    scale2 = np.exp(2 * log_scales)
    excess = scale2.sum(axis=1) - threshold
    is_above = (excess > 0)[:, None]
    return np.maximum(excess, 0).mean() / extent**2, 2 * scale2 * is_above / len(scale2) / extent**2


def anisotropy(log_scales: NDArray[Any], threshold: float) -> tuple[float, NDArray[Any]]:
    """Return the mean of max(longest / shortest axis - threshold, 0), and its gradient.  log_scales: [N, 3]."""
    rows = np.arange(len(log_scales))
    longest, shortest = log_scales.argmax(axis=1), log_scales.argmin(axis=1)
    ratio = np.exp(log_scales[rows, longest] - log_scales[rows, shortest])
    slope = np.where(ratio > threshold, ratio, 0) / len(rows)
    gradient = np.zeros_like(log_scales)
    gradient[rows, longest] += slope
    gradient[rows, shortest] -= slope
    return np.maximum(ratio - threshold, 0).mean(), gradient


def mean_scale(log_scales: NDArray[Any], extent: float) -> tuple[float, NDArray[Any]]:
    """Return the mean of scales / extent, and its gradient.  log_scales: [N, 3]."""
    scales = np.exp(log_scales)
    return scales.mean() / extent, scales / scales.size / extent


def min_scale(log_scales: NDArray[Any], extent: float) -> tuple[float, NDArray[Any]]:
    """Return the mean of the smallest scales / extent, and its gradient.  log_scales: [N, 3]."""
    smallest = np.exp(log_scales.min(axis=1, keepdims=True))
    is_smallest = log_scales == log_scales.min(axis=1, keepdims=True)
    return smallest.mean() / extent, smallest * is_smallest / len(log_scales) / extent


def mean_opacity(logit_opacity: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return the mean of the opacities, and its gradient.  logit_opacity: [N, 1]."""
    opacities = 1 / (1 + np.exp(-logit_opacity))
    return opacities.mean(), opacities * (1 - opacities) / opacities.size


def opacity_pressure(logit_opacity: NDArray[Any], floor: float) -> tuple[float, NDArray[Any]]:
    """Return the mean of max(logit - floor, 0), and its gradient.  logit_opacity: [N, 1]."""
    excess = np.maximum(logit_opacity - floor, 0)
    return excess.mean(), (excess > 0) / excess.size


# Density control: which Gaussians are cloned, split and pruned, and their children.

KEEP, CLONE, SPLIT, PRUNE = 0, 1, 2, 3  # the Gaussian becomes itself; itself twice; two children; nothing


@dataclass(frozen=True)
class DensityConstants:
    """The constants of density control.  Lengths are fractions of the scene extent."""

    clone_gradient: float = 2e-4
    split_gradient: float = 2e-4
    dense: float = 0.01
    min_opacity: float = 0.005
    prune_scale: float = 0.1
    split_factor: float = 1.6


VANILLA = DensityConstants()


def screen_gradient(grad_mean2d: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Return the norms, [N], of gradients in normalized device coordinates, from gradients per px, [N, 2]."""
    return np.hypot(width / 2 * grad_mean2d[:, 0], height / 2 * grad_mean2d[:, 1])


def screen_gain(grad_mean2d: NDArray[Any], conic: NDArray[Any]) -> NDArray[Any]:
    """Return the largest first-order change of the loss if a splat moves by one standard deviation, [N].

    This is the norm of Lᵀ g, where L Lᵀ is the covariance; 0 for culled splats.  grad_mean2d: [N, 2] px⁻¹; conic:
    [N, 3] px⁻².
    """
    gain = np.zeros(len(conic))
    for i, (xx, xy, yy) in enumerate(conic):
        if xx > 0:
            lower = np.linalg.cholesky(np.linalg.inv([[xx, xy], [xy, yy]]))
            gain[i] = np.linalg.norm(lower.T @ grad_mean2d[i])
    return gain


def mean_gradient(total: NDArray[Any], count: NDArray[Any]) -> NDArray[Any]:
    """Return the mean gradients, [N]; 0 for Gaussians that were never visible."""
    return np.where(count > 0, total / np.maximum(count, 1), 0)


def adc_actions(
    gradient: NDArray[Any],
    max_scale: NDArray[Any],
    opacity: NDArray[Any],
    extent: float,
    prune_large: bool,
    rule: DensityConstants = VANILLA,
    split_gradient: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Return KEEP, CLONE, SPLIT or PRUNE for each Gaussian, [N].

    Pruning is last, and applies to the new rows: copies and children have their parent's opacity, and children have its
    scale divided by 1.6.  split_gradient: the statistic for splits, such as the absolute gradient; None: `gradient`.
    """
    split_gradient = gradient if split_gradient is None else split_gradient
    actions = []
    for g, g_split, scale, o in zip(gradient, split_gradient, max_scale, opacity, strict=True):
        is_small = scale <= rule.dense * extent
        action = KEEP
        if is_small and g >= rule.clone_gradient:
            action = CLONE
        elif not is_small and g_split >= rule.split_gradient:
            action = SPLIT
        final_scale = scale / rule.split_factor if action == SPLIT else scale
        is_too_large = prune_large and final_scale > rule.prune_scale * extent
        actions.append(PRUNE if o < rule.min_opacity or is_too_large else action)
    return np.array(actions, int)


def shared_logit(logit: NDArray[Any], rows: int) -> NDArray[Any]:
    """Return the logits of `rows` equal Gaussians that together transmit as much as the original Gaussian.

    Their opacity o' satisfies 1 - o' = (1 - o)^(1/rows).
    """
    log_transmittance = -np.log1p(np.exp(logit)) / rows
    return np.log(-np.expm1(log_transmittance)) - log_transmittance


def reset_logit(logit: NDArray[Any], filter_ratio: NDArray[Any] | float = 1.0, limit: float = 0.01) -> NDArray[Any]:
    """Return logits, [N], whose opacities are at most `limit` after multiplication by the filter's `filter_ratio`."""
    opacity = np.minimum(filter_ratio / (1 + np.exp(-logit)), limit) / filter_ratio
    return np.log(opacity / (1 - opacity))


# The splitting matrix (SteepGS, Wang et al. 2025): the change of the loss if a splat is split in two.


def splitting_matrices(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> NDArray[Any]:
    """Return dL/dalpha times the Hessian of alpha with respect to the mean, summed over pixels, [N, 2, 2] px⁻²."""
    matrices = np.zeros((len(splats.opacity), 2, 2))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        a, b, c = splats.conic[step.splat]
        conic = np.array([[a, b], [b, c]])
        for row, column in np.argwhere(grad_alpha != 0):
            slope = conic @ [step.dx[row, column], step.dy[row, column]]
            hessian = step.alpha[row, column] * (np.outer(slope, slope) - conic)
            matrices[step.splat] += grad_alpha[row, column] * hessian
    return matrices


def mean_jacobian(camera: PinholeCamera, mean: NDArray[Any]) -> NDArray[Any]:
    """Return d(projected mean)/d(mean), [2, 3] px per scene unit."""
    x, y, z = camera.rotation @ mean + camera.translation
    perspective = np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]])
    return perspective @ camera.rotation


def scene_splitting_matrices(
    gaussians: RawGaussians, camera: PinholeCamera, screen_matrices: NDArray[Any]
) -> NDArray[Any]:
    """Convert matrices on the screen, [N, 2, 2], to matrices in the scene, [N, 3, 3], for constant splat shapes."""
    matrices = np.zeros((len(screen_matrices), 3, 3))
    for n in np.flatnonzero(screen_matrices.any(axis=(1, 2))):
        jacobian = mean_jacobian(camera, gaussians.means[n])
        matrices[n] = jacobian.T @ screen_matrices[n] @ jacobian
    return matrices


def shared_means(values: NDArray[Any], labels: NDArray[Any], weights: NDArray[Any]) -> NDArray[Any]:
    """Replace each row with the weighted mean of the rows that have its label; return [N, c].

    values: [N, c]; labels, weights: [N].  If all weights of a label are zero, its first row is used instead.
    """
    means = np.empty(values.shape)
    for label in np.unique(labels):
        members = np.flatnonzero(labels == label)
        rows, weight = values[members].astype(np.float64), weights[members].astype(np.float64)
        means[members] = weight @ rows / weight.sum() if weight.any() else rows[0]
    return means
