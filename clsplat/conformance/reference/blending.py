"""Blending, one splat at a time over all pixels, and its gradient; there are no tiles.

Kerbl et al. 2023, eq. 3.  `grad_x` is dL/dx; H, W image.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.kinds import Camera, Gaussians, SplatGradients, Splats, Thresholds
from clsplat.conformance.reference.pixel_box import box_derivatives, box_response
from clsplat.conformance.reference.projection import project
from clsplat.conformance.reference.projection_backward import project_backward
from clsplat.conformance.reference.sky import planes_behind


class BlendStep(NamedTuple):
    """One splat over all pixels; every array is [H,W]."""

    splat: int
    dx: NDArray[Any]
    dy: NDArray[Any]
    falloff: NDArray[Any]  # e^-σ
    alpha: NDArray[Any]
    before: NDArray[Any]  # transmittance in front of the splat
    tried: NDArray[Any]  # the pixel had not stopped yet
    candidate: NDArray[Any]  # tried and not too faint
    blended: NDArray[Any]  # candidate and does not make the pixel stop


def depth_order(splats: Splats) -> NDArray[Any]:
    """Visible splats front to back, ties by index."""
    order = np.argsort(splats.depth, kind="stable")
    return order[splats.visible[order]]


def blend_steps(splats: Splats, width: int, height: int, thresholds: Thresholds) -> Iterator[BlendStep]:
    """Walk through the splats front to back."""
    pixel_x, pixel_y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    transmittance = np.ones((height, width))
    running = np.ones((height, width), bool)
    for i in depth_order(splats):
        a, b, c = splats.conic[i]
        dx, dy = splats.mean2d[i, 0] - pixel_x, splats.mean2d[i, 1] - pixel_y
        sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy  # with the pixel's box only its sign counts
        falloff = box_response(splats.conic[i], dx, dy) if splats.pixel_box else np.exp(-sigma)
        alpha = np.minimum(thresholds.alpha_max, splats.opacity[i] * falloff)
        after = transmittance * (1 - alpha)
        candidate = running & (sigma >= 0) & (alpha >= thresholds.alpha_min)
        stops = candidate & (after < thresholds.transmittance_min)
        blended = candidate & ~stops
        yield BlendStep(i, dx, dy, falloff, alpha, transmittance, running, candidate, blended)
        running = running & ~stops
        transmittance = np.where(blended, after, transmittance)


def blend(
    splats: Splats, width: int, height: int, background: NDArray[Any], thresholds: Thresholds = Thresholds()
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Image [3,H,W], final transmittance [H,W], number of blended splats [H,W]."""
    image = np.zeros((3, height, width))
    transmittance = np.ones((height, width))
    count = np.zeros((height, width), int)
    for step in blend_steps(splats, width, height, thresholds):
        weight = np.where(step.blended, step.alpha * step.before, 0)
        image += splats.colour[step.splat][:, None, None] * weight
        transmittance = np.where(step.blended, step.before * (1 - step.alpha), transmittance)
        count += step.blended
    return image + planes_behind(background) * transmittance, transmittance, count


def blend_weights(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> NDArray[Any]:
    """What each splat contributes to each pixel, α T, [N,H,W]."""
    weights = np.zeros((len(splats.opacity), height, width))
    for step in blend_steps(splats, width, height, thresholds):
        weights[step.splat] = np.where(step.blended, step.alpha * step.before, 0)
    return weights


def weight_entropy(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> NDArray[Any]:
    """-Σ w ln w of the weights of all splats and of what they leave, [H,W]."""
    weights = blend_weights(splats, width, height, thresholds)
    weights = np.concatenate([weights, 1 - weights.sum(axis=0, keepdims=True)])
    return -np.sum(weights * np.log(np.where(weights > 0, weights, 1)), axis=0)


def entropy_gradients(splats: Splats, width: int, height: int, thresholds: Thresholds) -> Iterator[NDArray[Any]]:
    """d(entropy)/d(alpha) of each splat front to back, [H,W]: -(ln w + 1) T + Σ_behind (ln w + 1) w / (1 - alpha)."""
    steps = list(blend_steps(splats, width, height, thresholds))
    weights = [np.where(step.blended, step.alpha * step.before, 0) for step in steps]
    weights.append(1 - np.sum(weights, axis=0))
    terms = [(np.log(np.where(weight > 0, weight, 1)) + 1) * weight for weight in weights]
    for n, step in enumerate(steps):
        own = (np.log(np.where(weights[n] > 0, weights[n], 1)) + 1) * step.before
        yield -own + np.sum(terms[n + 1 :], axis=0) / (1 - step.alpha)


def contribution(
    splats: Splats, width: int, height: int, mask: NDArray[Any] | None = None, thresholds: Thresholds = Thresholds()
) -> NDArray[Any]:
    """Blend weights summed over the pixels of a view that count, [N]; `mask`: [H,W], None: all count."""
    weights = blend_weights(splats, width, height, thresholds)
    return np.sum(weights if mask is None else weights * mask, axis=(1, 2))


def alpha_gradients(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> Iterator[tuple[BlendStep, NDArray[Any]]]:
    """Each splat front to back with dL/dalpha, [H,W], in the prefix form; where alpha is capped it is zero.

    grad_image: [3,H,W], or [4,H,W] with the derivative by the entropy of weights.
    """
    grad_image, grad_entropy = grad_image[:3], grad_image[3:]
    entropy = entropy_gradients(splats, width, height, thresholds) if len(grad_entropy) else iter(())
    image, final, _ = blend(splats, width, height, background, thresholds)
    through_background = (planes_behind(background) * grad_image).sum(axis=0)
    behind = image - planes_behind(background) * final  # S_N - S_i, once splat i has been taken off
    for step in blend_steps(splats, width, height, thresholds):
        i, alpha, before = step.splat, step.alpha, step.before
        colour = splats.colour[i][:, None, None]
        behind = behind - colour * np.where(step.blended, alpha * before, 0)
        grad_alpha = np.sum((colour * before - behind / (1 - alpha)) * grad_image, axis=0)
        grad_alpha -= final / (1 - alpha) * through_background
        if len(grad_entropy):
            grad_alpha += grad_entropy[0] * next(entropy)
        capped = splats.opacity[i] * step.falloff > thresholds.alpha_max
        yield step, np.where(step.blended & ~capped, grad_alpha, 0)


def blend_backward(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> SplatGradients:
    """Gradients of the splats; grad_image: as in `alpha_gradients`."""
    n = len(splats.opacity)
    grad = SplatGradients(np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 2)))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        i = step.splat
        grad.colour[i] = np.sum(grad_image[:3] * np.where(step.blended, step.alpha * step.before, 0), axis=(1, 2))
        grad.opacity[i] = np.sum(step.falloff * grad_alpha)
        if splats.pixel_box:
            by = splats.opacity[i] * grad_alpha * np.array(box_derivatives(splats.conic[i], step.dx, step.dy))
            grad.mean2d[i], grad.conic[i] = by[:2].sum(axis=(1, 2)), by[2:].sum(axis=(1, 2))
            grad.mean2d_abs[i] = np.abs(by[:2]).sum(axis=(1, 2))
            continue
        grad_sigma = -splats.opacity[i] * step.falloff * grad_alpha
        a, b, c = splats.conic[i]
        grad_u = grad_sigma * (a * step.dx + b * step.dy)
        grad_v = grad_sigma * (b * step.dx + c * step.dy)
        grad.mean2d[i] = grad_u.sum(), grad_v.sum()
        grad.mean2d_abs[i] = np.abs(grad_u).sum(), np.abs(grad_v).sum()
        products = 0.5 * step.dx**2, step.dx * step.dy, 0.5 * step.dy**2
        grad.conic[i] = [np.sum(grad_sigma * product) for product in products]
    return grad


def falloff_squares(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> NDArray[Any]:
    """(dL/dG)² summed over pixels, [N], where alpha is the opacity times G."""
    squares = np.zeros(len(splats.opacity))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        squares[step.splat] = np.sum((splats.opacity[step.splat] * grad_alpha) ** 2)
    return squares


class Margin(NamedTuple):
    """Smallest relative distances to a decision that float32 might take differently; inf where there is none."""

    alpha: float  # |α / alpha_min - 1| over pixels that have not stopped
    transmittance: float  # |T' / transmittance_min - 1| over splats that are not too faint
    cap: float  # |o e^-σ / alpha_max - 1|: the image is continuous there, its gradient is not
    depth: float  # relative gap between neighbours in the depth order


def margin(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> Margin:
    """Return how far blending stays from its thresholds, so that a test can choose a scene without flips."""
    alpha, transmittance, cap = [np.inf], [np.inf], [np.inf]
    for step in blend_steps(splats, width, height, thresholds):
        uncapped = splats.opacity[step.splat] * step.falloff
        cap.append(_relative_gap(uncapped[step.candidate], thresholds.alpha_max))
        alpha.append(_relative_gap(step.alpha[step.tried], thresholds.alpha_min))
        after = step.before * (1 - step.alpha)
        transmittance.append(_relative_gap(after[step.candidate], thresholds.transmittance_min))
    depth = splats.depth[depth_order(splats)]
    gap = np.min(np.diff(depth) / depth[1:], initial=np.inf)
    return Margin(min(alpha), min(transmittance), min(cap), float(gap))


def _relative_gap(values: NDArray[Any], threshold: float) -> float:
    return float(np.min(np.abs(values / threshold - 1), initial=np.inf)) if threshold > 0 else np.inf


class Frame(NamedTuple):
    """What `render` returns."""

    image: NDArray[Any]  # [3,H,W]
    transmittance: NDArray[Any]  # [H,W]
    blended: NDArray[Any]  # [H,W] splats
    splats: Splats


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: NDArray[Any],
    degree: int,
    near: float = 0.2,
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: Thresholds = Thresholds(),
    pixel_box: float = 0.0,
) -> Frame:
    """Project and blend."""
    splats = project(gaussians, camera, degree, near, variance, compensate, thresholds, pixel_box)
    return Frame(*blend(splats, camera.width, camera.height, background, thresholds), splats)


def render_backward(
    gaussians: Gaussians,
    camera: Camera,
    background: NDArray[Any],
    degree: int,
    splats: Splats,
    grad_image: NDArray[Any],
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: Thresholds = Thresholds(),
) -> tuple[dict[str, NDArray[Any]], SplatGradients]:
    """Gradients of the parameters, and those of the splats on the way (for density control)."""
    grad = blend_backward(splats, camera.width, camera.height, background, grad_image, thresholds)
    upstream = grad.mean2d, grad.conic, grad.opacity, grad.colour
    return project_backward(gaussians, camera, degree, variance, compensate, splats, *upstream), grad
