"""Density control: which Gaussians are cloned, split and pruned, and their children."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.projection import rotation_matrix

KEEP, CLONE, SPLIT, PRUNE = 0, 1, 2, 3  # rows left afterwards: itself; itself twice; two children; none


@dataclass(frozen=True)
class DensityRule:
    """Constants; lengths are fractions of the scene extent."""

    clone_gradient: float = 2e-4
    split_gradient: float = 2e-4
    dense: float = 0.01
    min_opacity: float = 0.005
    prune_scale: float = 0.1
    split_factor: float = 1.6


VANILLA = DensityRule()
ABSGS = DensityRule(split_gradient=4e-4, dense=0.001)


def screen_gradient(grad_mean2d: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """‖g2d‖: pixels -> normalised device coordinates: [N,2] -> [N].  Also for `mean2d_abs`."""
    return np.hypot(width / 2 * grad_mean2d[:, 0], height / 2 * grad_mean2d[:, 1])


def screen_gain(grad_mean2d: NDArray[Any], conic: NDArray[Any]) -> NDArray[Any]:
    """Largest change of the loss by a shift of one standard deviation, to first order: [N]; 0 for a culled splat.

    grad_mean2d: [N,2] px^-1; conic: [N,3] px^-2.  It is the length of L^T g, with L L^T the covariance.
    """
    found = np.zeros(len(conic))
    for i, (xx, xy, yy) in enumerate(conic):
        if xx > 0:
            lower = np.linalg.cholesky(np.linalg.inv([[xx, xy], [xy, yy]]))
            found[i] = np.linalg.norm(lower.T @ grad_mean2d[i])
    return found


def mean_gradient(total: NDArray[Any], count: NDArray[Any]) -> NDArray[Any]:
    """ḡ: [N]; 0 where the Gaussian was never visible."""
    return np.where(count > 0, total / np.maximum(count, 1), 0)


def adc_actions(
    gradient: NDArray[Any],
    max_scale: NDArray[Any],
    opacity: NDArray[Any],
    extent: float,
    prune_large: bool,
    rule: DensityRule = VANILLA,
    split_gradient: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """KEEP, CLONE, SPLIT or PRUNE per Gaussian: [N].

    Pruning comes last and sees the new rows: copies and children have their parent's opacity, children its scale / 1.6.
    `split_gradient` is the statistic of the split test where it is another one (ḡabs); `prune_large` is i > 3000.
    """
    split_gradient = gradient if split_gradient is None else split_gradient
    actions = []
    for g, g_split, scale, o in zip(gradient, split_gradient, max_scale, opacity, strict=True):
        small = scale <= rule.dense * extent
        action = KEEP
        if small and g >= rule.clone_gradient:
            action = CLONE
        elif not small and g_split >= rule.split_gradient:
            action = SPLIT
        final_scale = scale / rule.split_factor if action == SPLIT else scale
        too_large = prune_large and final_scale > rule.prune_scale * extent
        actions.append(PRUNE if o < rule.min_opacity or too_large else action)
    return np.array(actions, int)


def split_children(
    mean: NDArray[Any],
    quat: NDArray[Any],
    log_scale: NDArray[Any],
    noise: NDArray[Any],
    factor: float = VANILLA.split_factor,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Means and log-scales of the children of one Gaussian; `noise` is N(0, 1): [2,3] -> [2,3], [2,3]."""
    rotation, scale = rotation_matrix(quat), np.exp(log_scale)
    means = np.array([mean + rotation @ (scale * sample) for sample in noise])
    return means, np.array([log_scale - np.log(factor) for _ in noise])


def shared_logit(logit: NDArray[Any], rows: int) -> NDArray[Any]:
    """Logits of `rows` Gaussians in one place that together let through as much as one did: 1 - o' = (1 - o)^(1/n)."""
    log_transmittance = -np.log1p(np.exp(logit)) / rows
    return np.log(-np.expm1(log_transmittance)) - log_transmittance


def decayed_logit(logit: NDArray[Any], factor: float) -> NDArray[Any]:
    """The logit of `factor` times the opacity."""
    opacity = factor / (1 + np.exp(-logit))
    return np.log(opacity / (1 - opacity))


def reset_logit(logit: NDArray[Any], filter_ratio: NDArray[Any] | float = 1.0, ceiling: float = 0.01) -> NDArray[Any]:
    """Opacity reset (6; 8.3 with `filter_ratio` = ρ): the filtered opacity becomes at most `ceiling`: [N]."""
    opacity = np.minimum(filter_ratio / (1 + np.exp(-logit)), ceiling) / filter_ratio
    return np.log(opacity / (1 - opacity))
