"""Blend one splat after another over all pixels, without tiles, and compute the gradient.

Kerbl et al. 2023, eq. 3.  `grad_x` is dL/dx; H and W are the size of the image.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.projection import project
from clsplat.conformance.reference.types import PinholeCamera, RawGaussians, SplatGradients, Splats, Thresholds

# The mean of a Gaussian over the box of a pixel, as the kernels approximate it (cl_kernels/pixel_box.h).

Floats = NDArray[Any]
SLOPE, CUBIC, QUINTIC = 1.5957691, 0.07333173, -0.00059424  # Φ(x) = 1 / (1 + e^-P), P = SLOPE x + CUBIC x³ + …
REACH = 6.0  # standard deviations beyond which Φ is constant
SERIES_BELOW = 0.4  # half a pixel, in standard deviations, below which mean and variance are computed as series
DIFFERENCE_STEP = 1e-5  # step of finite differences, px or px², relative to the size of the splat


def cdf(x: Floats) -> Floats:
    """Return Φ(x), the cumulative normal distribution."""
    x = np.clip(x, -REACH, REACH)
    square = x * x
    return 1 / (1 + np.exp(-x * (SLOPE + square * (CUBIC + square * QUINTIC))))


def density(x: Floats) -> Floats:
    """Return the derivative of `cdf`."""
    x = np.clip(x, -REACH, REACH)
    square, probability = x * x, cdf(x)
    return probability * (1 - probability) * (SLOPE + square * (3 * CUBIC + square * (5 * QUINTIC)))


def moments(dy: Floats, s: float) -> tuple[Floats, Floats, Floats]:
    """Return the mass, mean, and variance of the part of a centered normal distribution within ½ px of `dy`.

    dy: at least 0, in px; s: standard deviation, in px.
    """
    low, high = -(dy + 0.5) / s, -(dy - 0.5) / s  # mirrored to the side where Φ is small and precise
    mass = np.maximum(cdf(high) - cdf(low), 1e-30)
    if 0.5 / s < SERIES_BELOW:
        tilt = dy / s**2
        mean = dy - tilt * (1 / 12 - 1 / (360 * s**2) - tilt**2 / 720)
        return mass, mean, np.maximum(1 / 12 - 1 / (360 * s**2) - tilt**2 / 240, 0)
    low, high = np.clip(low, -REACH, REACH), np.clip(high, -REACH, REACH)
    mean = (density(low) - density(high)) / mass
    variance = 1 + (low * density(low) - high * density(high)) / mass - mean**2
    return mass, np.clip(-mean * s, dy - 0.5, dy + 0.5), np.clip(variance * s**2, 0, 1 / 12)


def box_response(covariance: Floats, dx: Floats, dy: Floats) -> Floats:
    """Return the mean of e^(-dᵀ V⁻¹ d / 2) over the pixel at (dx, dy) px.  covariance: V as [xx, xy, yy] px²."""
    xx, xy, yy = covariance
    if xx > yy:
        return box_response(np.array([yy, xy, xx]), dy, dx)
    k, sy, sx = xy / yy, np.sqrt(yy), np.sqrt(xx - xy * xy / yy)
    mass, mean, variance = moments(np.abs(dy), sy)
    mean = np.where(dy < 0, -mean, mean)
    r = 12 * k * k * variance
    width = (1 + r * r) ** 0.25
    blur = np.sqrt(sx * sx + (1 + r - width * width) / 12)
    offset = -np.abs(dx - k * mean)
    across = cdf((offset + width / 2) / blur) - cdf((offset - width / 2) / blur)
    return np.asarray(2 * np.pi * sy * sx * mass / width * across)


def box_derivatives(covariance: Floats, dx: Floats, dy: Floats) -> tuple[Floats, ...]:
    """Return the derivatives with respect to dx, dy, xx, xy, yy, by central differences."""

    def difference(step: float, **unit: float) -> Floats:
        values = []
        for sign in (1, -1):
            v = covariance + sign * step * np.array([unit.get("xx", 0), unit.get("xy", 0), unit.get("yy", 0)])
            values.append(box_response(v, dx + sign * step * unit.get("x", 0), dy + sign * step * unit.get("y", 0)))
        return (values[0] - values[1]) / (2 * step)

    xx, xy, yy = covariance
    distance = DIFFERENCE_STEP * np.sqrt(xx - xy * xy / yy)
    area = DIFFERENCE_STEP * (xx * yy - xy * xy) / max(xx, yy)
    return (
        difference(distance, x=1),
        difference(distance, y=1),
        difference(area, xx=1),
        difference(area, xy=1),
        difference(area, yy=1),
    )


class BlendStep(NamedTuple):
    """The blending of one splat over all pixels; every array is [H, W]."""

    splat: int
    dx: NDArray[Any]
    dy: NDArray[Any]
    falloff: NDArray[Any]  # e^-σ
    alpha: NDArray[Any]
    transmittance: NDArray[Any]  # in front of the splat
    is_active: NDArray[Any]  # whether blending had not stopped before the splat
    is_candidate: NDArray[Any]  # whether it is active, and the splat is not too faint
    is_blended: NDArray[Any]  # whether it is a candidate, and blending does not stop at the splat


def depth_order(splats: Splats) -> NDArray[Any]:
    """Return the indices of visible splats front to back, ties by index."""
    order = np.argsort(splats.depth, kind="stable")
    return order[splats.visible[order]]


def blend_steps(splats: Splats, width: int, height: int, thresholds: Thresholds) -> Iterator[BlendStep]:
    """Blend the visible splats front to back, and yield the values of the pixels at each splat."""
    pixel_x, pixel_y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    transmittance = np.ones((height, width))
    is_active = np.ones((height, width), bool)
    for i in depth_order(splats):
        a, b, c = splats.conic[i]
        dx, dy = splats.mean2d[i, 0] - pixel_x, splats.mean2d[i, 1] - pixel_y
        sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy  # only its sign matters for the pixel's box
        falloff = box_response(splats.conic[i], dx, dy) if splats.pixel_box else np.exp(-sigma)
        alpha = np.minimum(thresholds.alpha_max, splats.opacity[i] * falloff)
        after = transmittance * (1 - alpha)
        is_candidate = is_active & (sigma >= 0) & (alpha >= thresholds.alpha_min)
        stops = is_candidate & (after < thresholds.transmittance_min)
        is_blended = is_candidate & ~stops
        yield BlendStep(i, dx, dy, falloff, alpha, transmittance, is_active, is_candidate, is_blended)
        is_active = is_active & ~stops
        transmittance = np.where(is_blended, after, transmittance)


def background_planes(background: NDArray[Any]) -> NDArray[Any]:
    """Return a background color, [3], or image, [3, H, W], as planes."""
    array = np.asarray(background)
    return array if array.ndim == 3 else array[:, None, None]


def blend(
    splats: Splats, width: int, height: int, background: NDArray[Any], thresholds: Thresholds = Thresholds()
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the image, [3, H, W], the final transmittance, [H, W], and the number of blended splats, [H, W]."""
    image = np.zeros((3, height, width))
    transmittance = np.ones((height, width))
    count = np.zeros((height, width), int)
    for step in blend_steps(splats, width, height, thresholds):
        weight = np.where(step.is_blended, step.alpha * step.transmittance, 0)
        image += splats.color[step.splat][:, None, None] * weight
        transmittance = np.where(step.is_blended, step.transmittance * (1 - step.alpha), transmittance)
        count += step.is_blended
    return image + background_planes(background) * transmittance, transmittance, count


def blend_weights(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> NDArray[Any]:
    """Return the contribution of each splat to each pixel, α T, [N,H,W]."""
    weights = np.zeros((len(splats.opacity), height, width))
    for step in blend_steps(splats, width, height, thresholds):
        weights[step.splat] = np.where(step.is_blended, step.alpha * step.transmittance, 0)
    return weights


def contribution(
    splats: Splats, width: int, height: int, mask: NDArray[Any] | None = None, thresholds: Thresholds = Thresholds()
) -> NDArray[Any]:
    """Return blend weights summed over the unmasked pixels of a view, [N].  mask: [H, W], or None for all pixels."""
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
    """Blend the visible splats front to back, and yield the values at each splat, with dL/dalpha, [H, W].

    dL/dalpha is zero where alpha is capped.  grad_image: [3, H, W].
    """
    image, final, _ = blend(splats, width, height, background, thresholds)
    through_background = (background_planes(background) * grad_image).sum(axis=0)
    behind = image - background_planes(background) * final  # S_N - S_i, after subtracting splat i
    for step in blend_steps(splats, width, height, thresholds):
        i, alpha, before = step.splat, step.alpha, step.transmittance
        color = splats.color[i][:, None, None]
        behind = behind - color * np.where(step.is_blended, alpha * before, 0)
        grad_alpha = np.sum((color * before - behind / (1 - alpha)) * grad_image, axis=0)
        grad_alpha -= final / (1 - alpha) * through_background
        is_capped = splats.opacity[i] * step.falloff > thresholds.alpha_max
        yield step, np.where(step.is_blended & ~is_capped, grad_alpha, 0)


def blend_backward(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> SplatGradients:
    """Return the gradients of the splats.  grad_image: [3, H, W]."""
    n = len(splats.opacity)
    grad = SplatGradients(np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 2)))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        i = step.splat
        grad.color[i] = np.sum(grad_image * np.where(step.is_blended, step.alpha * step.transmittance, 0), axis=(1, 2))
        grad.opacity[i] = np.sum(step.falloff * grad_alpha)
        if splats.pixel_box:
            grads = splats.opacity[i] * grad_alpha * np.array(box_derivatives(splats.conic[i], step.dx, step.dy))
            grad.mean2d[i], grad.conic[i] = grads[:2].sum(axis=(1, 2)), grads[2:].sum(axis=(1, 2))
            grad.mean2d_abs[i] = np.abs(grads[:2]).sum(axis=(1, 2))
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
    """Return (dL/dG)² summed over pixels, [N], where G is the falloff: alpha is the opacity times G."""
    squares = np.zeros(len(splats.opacity))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        squares[step.splat] = np.sum((splats.opacity[step.splat] * grad_alpha) ** 2)
    return squares


class Margin(NamedTuple):
    """The smallest relative distances of values to thresholds that rounding may cross; infinity if there are none."""

    alpha: float  # |α / alpha_min - 1| over pixels where blending has not stopped
    transmittance: float  # |T' / transmittance_min - 1| over splats that are not too faint
    cap: float  # |o e^-σ / alpha_max - 1|: the image is continuous there, its gradient is not
    depth: float  # relative gap between consecutive splats in the depth order


def margin(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> Margin:
    """Return the margin of a scene, with which tests can find scenes that float32 and float64 blend alike."""
    alpha, transmittance, cap = [np.inf], [np.inf], [np.inf]
    for step in blend_steps(splats, width, height, thresholds):
        uncapped = splats.opacity[step.splat] * step.falloff
        cap.append(_relative_gap(uncapped[step.is_candidate], thresholds.alpha_max))
        alpha.append(_relative_gap(step.alpha[step.is_active], thresholds.alpha_min))
        after = step.transmittance * (1 - step.alpha)
        transmittance.append(_relative_gap(after[step.is_candidate], thresholds.transmittance_min))
    depth = splats.depth[depth_order(splats)]
    gap = np.min(np.diff(depth) / depth[1:], initial=np.inf)
    return Margin(min(alpha), min(transmittance), min(cap), float(gap))


def _relative_gap(values: NDArray[Any], threshold: float) -> float:
    return float(np.min(np.abs(values / threshold - 1), initial=np.inf)) if threshold > 0 else np.inf


class RenderOutput(NamedTuple):
    """A rendered image, the transmittance and splat count of its pixels, and the projected Gaussians."""

    image: NDArray[Any]  # [3,H,W]
    transmittance: NDArray[Any]  # [H,W]
    splat_count: NDArray[Any]  # [H,W] number of blended splats
    splats: Splats


def render(
    gaussians: RawGaussians,
    camera: PinholeCamera,
    background: NDArray[Any],
    degree: int,
    near: float = 0.2,
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: Thresholds = Thresholds(),
    pixel_box: float = 0.0,
) -> RenderOutput:
    """Project and blend Gaussians.  Arguments are as in `project`; background: [3] or [3, H, W]."""
    splats = project(gaussians, camera, degree, near, variance, compensate, thresholds, pixel_box)
    return RenderOutput(*blend(splats, camera.width, camera.height, background, thresholds), splats)


# The blended inverse depth, its gradient, and the loss against measured depths of some pixels.

BLACK = np.zeros(3)


def _color_by_inverse_depth(splats: Splats) -> Splats:
    inverse = np.where(splats.visible, 1 / np.where(splats.visible, splats.depth, 1), 0)
    return replace(splats, color=np.stack([inverse, *np.zeros((2, len(inverse)))], axis=1))


def inverse_depth(splats: Splats, width: int, height: int, thresholds: Thresholds = Thresholds()) -> Floats:
    """Return the blended inverse depth D, [H,W]."""
    image, _, _ = blend(_color_by_inverse_depth(splats), width, height, BLACK, thresholds)
    return np.asarray(image[0])


def median_depth(splats: Splats, width: int, height: int) -> tuple[Floats, Floats]:
    """Return the depth of the splat that takes the transmittance T below ½, and the smallest |T - ½|, both [H, W].

    The depth is 0 where T stays at or above ½.
    """
    depth, gap = np.zeros((height, width)), np.full((height, width), 0.5)
    for step in blend_steps(splats, width, height, Thresholds()):
        after = step.transmittance * np.where(step.is_blended, 1 - step.alpha, 1)
        depth = np.where((step.transmittance >= 0.5) & (after < 0.5), splats.depth[step.splat], depth)
        gap = np.minimum(gap, np.abs(after - 0.5))
    return depth, gap


def inverse_depth_backward(
    splats: Splats, width: int, height: int, grad: Floats, thresholds: Thresholds = Thresholds()
) -> tuple[SplatGradients, Floats]:
    """Return the gradients of the splats, which are zero for colors, and dL/dz, [N].  grad: dL/dD, [H, W]."""
    planes = np.stack([grad, *np.zeros((2, *grad.shape))])
    grads = blend_backward(_color_by_inverse_depth(splats), width, height, BLACK, planes, thresholds)
    grad_depth = -grads.color[:, 0] * _color_by_inverse_depth(splats).color[:, 0] ** 2
    return grads._replace(color=0 * grads.color), grad_depth


def inverse_depth_loss(
    plane: Floats, positions: tuple[Floats, Floats], targets: Floats, weights: Floats
) -> tuple[Floats, Floats]:
    """Return the losses weight * |D - target|, [K], and the gradient of their sum, [H, W].

    plane: D, [H, W]; positions: rows and columns of the pixels; targets: inverse depths, [K].
    """
    difference = plane[positions] - targets
    gradient = np.zeros(plane.shape)
    gradient[positions] = weights * np.sign(difference)
    return weights * np.abs(difference), gradient


# A layer in front of an image: the composite, the gradient of the image, and the loss on the layer's opacity.


def overlay(layer: NDArray[Any], transmittance: NDArray[Any], image: NDArray[Any]) -> NDArray[Any]:
    """Composite a layer, rendered on black, over the first 3 planes of an image, [C, H, W]; keep the other planes."""
    return np.concatenate([layer + transmittance * image[:3], image[3:]])


def gradient_behind(transmittance: NDArray[Any], gradient: NDArray[Any]) -> NDArray[Any]:
    """Return the gradient of the image behind a layer, given the gradient of the composite."""
    return np.concatenate([transmittance * gradient[:3], gradient[3:]])


def layer_cover(transmittance: NDArray[Any], scale: float) -> tuple[float, NDArray[Any]]:
    """Return the loss, `scale` times the sum of 1 - T, and its gradient with respect to the transmittance T."""
    return scale * float((1 - transmittance).sum()), np.full_like(transmittance, -scale)
