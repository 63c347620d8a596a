"""The oracle, second part: image losses, Adam and density control in float64 NumPy.

Images are [C,H,W]: x is the render, y the target; gradients
are with respect to x.
"""

from dataclasses import dataclass

import numpy as np

from tests.reference import rotation_matrix

# ---- Losses and metrics --------------------------------------------------------------------------------------------

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def l1(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean absolute difference, and its gradient."""
    return np.mean(np.abs(x - y)), np.sign(x - y) / x.size


def l2(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean squared difference, and its gradient."""
    return np.mean((x - y) ** 2), 2 * (x - y) / x.size


def psnr(x: np.ndarray, y: np.ndarray) -> float:
    """Peak signal-to-noise ratio of images in [0, 1], in dB."""
    return 10 * np.log10(1 / np.mean((x - y) ** 2))


def ssim_taps() -> np.ndarray:
    """The 11 weights of the window, which sum to one."""
    weights = np.exp(-(np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) ** 2) / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def window_mean(image: np.ndarray) -> np.ndarray:
    """Weighted mean over 11x11 pixels, zeros outside the image: one term per offset."""
    taps = ssim_taps()
    _, height, width = image.shape
    padded = np.pad(image, ((0, 0), (SSIM_RADIUS, SSIM_RADIUS), (SSIM_RADIUS, SSIM_RADIUS)))
    total = np.zeros(image.shape)
    for row, weight_y in enumerate(taps):
        for column, weight_x in enumerate(taps):
            total += weight_y * weight_x * padded[:, row : row + height, column : column + width]
    return total


def _ssim_terms(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """μ1, μ2, a1, a2, b1, b2."""
    mu1, mu2 = window_mean(x), window_mean(y)
    variance1 = window_mean(x * x) - mu1**2
    variance2 = window_mean(y * y) - mu2**2
    covariance = window_mean(x * y) - mu1 * mu2
    a1, a2 = 2 * mu1 * mu2 + C1, 2 * covariance + C2
    b1, b2 = mu1**2 + mu2**2 + C1, variance1 + variance2 + C2
    return mu1, mu2, a1, a2, b1, b2


def ssim_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """SSIM of every pixel and channel: [C,H,W]."""
    _, _, a1, a2, b1, b2 = _ssim_terms(x, y)
    return a1 * a2 / (b1 * b2)


def dssim(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """1 - mean SSIM, and its gradient."""
    mu1, mu2, a1, a2, b1, b2 = _ssim_terms(x, y)
    m = a1 * a2 / (b1 * b2)
    d_mu = 2 * mu2 * (a2 - a1) / (b1 * b2) - 2 * mu1 * m * (1 / b1 - 1 / b2)
    d_variance = -m / b2
    d_covariance = 2 * a1 / (b1 * b2)
    g = -1 / x.size
    grad = window_mean(g * d_mu) + 2 * x * window_mean(g * d_variance) + y * window_mean(g * d_covariance)
    return 1 - np.mean(m), grad


def ms_ssim(x: np.ndarray, y: np.ndarray, scales: int) -> float:
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


# ---- Adam ----------------------------------------------------------------------------------------------------------


def adam_step(
    parameter: np.ndarray,
    grad: np.ndarray,
    moment1: np.ndarray,
    moment2: np.ndarray,
    step: int,
    rate: float,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New parameter and moments; `step` counts from 1.  PyTorch's form: epsilon outside the root."""
    moment1 = beta1 * moment1 + (1 - beta1) * grad
    moment2 = beta2 * moment2 + (1 - beta2) * grad**2
    mean = moment1 / (1 - beta1**step)
    square = moment2 / (1 - beta2**step)
    return parameter - rate * mean / (np.sqrt(square) + epsilon), moment1, moment2


# ---- Density control -----------------------------------------------------------------------------------------------

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


def screen_gradient(grad_mean2d: np.ndarray, width: int, height: int) -> np.ndarray:
    """‖g2d‖: pixels -> normalised device coordinates: [N,2] -> [N].  Also for `mean2d_abs`."""
    return np.hypot(width / 2 * grad_mean2d[:, 0], height / 2 * grad_mean2d[:, 1])


def mean_gradient(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """ḡ: [N]; 0 where the Gaussian was never visible."""
    return np.where(count > 0, total / np.maximum(count, 1), 0)


def adc_actions(
    gradient: np.ndarray,
    max_scale: np.ndarray,
    opacity: np.ndarray,
    extent: float,
    prune_large: bool,
    rule: DensityRule = VANILLA,
    split_gradient: np.ndarray | None = None,
) -> np.ndarray:
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
    mean: np.ndarray, quat: np.ndarray, log_scale: np.ndarray, noise: np.ndarray, factor: float = VANILLA.split_factor
) -> tuple[np.ndarray, np.ndarray]:
    """Means and log-scales of the children of one Gaussian; `noise` is N(0, 1): [2,3] -> [2,3], [2,3]."""
    rotation, scale = rotation_matrix(quat), np.exp(log_scale)
    means = np.array([mean + rotation @ (scale * sample) for sample in noise])
    return means, np.array([log_scale - np.log(factor) for _ in noise])


def reset_logit(logit: np.ndarray, filter_ratio: np.ndarray | float = 1.0, ceiling: float = 0.01) -> np.ndarray:
    """Opacity reset (6; 8.3 with `filter_ratio` = ρ): the filtered opacity becomes at most `ceiling`: [N]."""
    opacity = np.minimum(filter_ratio / (1 + np.exp(-logit)), ceiling) / filter_ratio
    return np.log(opacity / (1 - opacity))
