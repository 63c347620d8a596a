"""Gradients of the projection, one Gaussian at a time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.harmonics import sh_basis, sh_basis_gradient
from clsplat.conformance.reference.kinds import PARAMETERS, Camera, Gaussians, Splats
from clsplat.conformance.reference.projection import (
    Footprint,
    adjugate,
    clamped_ray,
    determinant,
    footprint,
    opacity_factors,
    ray_limits,
    unclamped_colour,
    view_direction,
)


def quat_gradient(quat: NDArray[Any], h: NDArray[Any]) -> NDArray[Any]:
    """dL/dq of the raw quaternion from H = dL/dR."""
    norm = np.linalg.norm(quat)
    unit = quat / norm
    w, x, y, z = unit
    gw = 2 * (z * (h[1, 0] - h[0, 1]) + y * (h[0, 2] - h[2, 0]) + x * (h[2, 1] - h[1, 2]))
    gx = 2 * (y * (h[0, 1] + h[1, 0]) + z * (h[0, 2] + h[2, 0]) + w * (h[2, 1] - h[1, 2]) - 2 * x * (h[1, 1] + h[2, 2]))
    gy = 2 * (x * (h[0, 1] + h[1, 0]) + z * (h[1, 2] + h[2, 1]) + w * (h[0, 2] - h[2, 0]) - 2 * y * (h[0, 0] + h[2, 2]))
    gz = 2 * (x * (h[0, 2] + h[2, 0]) + y * (h[1, 2] + h[2, 1]) + w * (h[1, 0] - h[0, 1]) - 2 * z * (h[0, 0] + h[1, 1]))
    grad_unit = np.array([gw, gx, gy, gz])
    return (grad_unit - unit * (unit @ grad_unit)) / norm


def point_gradient(camera: Camera, foot: Footprint, grad_mean2d: NDArray[Any], grad_j: NDArray[Any]) -> NDArray[Any]:
    """dL/d(camera-space point), through the screen position and through J with its clamped ray."""
    x, y, z = foot.point
    fx, fy = camera.fx, camera.fy
    gu, gv = grad_mean2d
    gx, gy = fx / z * gu, fy / z * gv
    gz = -(fx * x * gu + fy * y * gv) / z**2 - fx / z**2 * grad_j[0, 0] - fy / z**2 * grad_j[1, 1]
    tx, ty = clamped_ray(camera, foot.point)
    (x_low, x_high), (y_low, y_high) = ray_limits(camera)
    if x_low <= x / z <= x_high:
        gx += -fx / z**2 * grad_j[0, 2]
        gz += 2 * fx * x / z**3 * grad_j[0, 2]
    else:  # tx = limit * z, so J02 goes like 1/z and x is not in it
        gz += fx * tx / z**3 * grad_j[0, 2]
    if y_low <= y / z <= y_high:
        gy += -fy / z**2 * grad_j[1, 2]
        gz += 2 * fy * y / z**3 * grad_j[1, 2]
    else:
        gz += fy * ty / z**3 * grad_j[1, 2]
    return np.array([gx, gy, gz])


def ratio_gradient(foot: Footprint) -> NDArray[Any]:
    """d(det V / det V1)/dV, by the quotient rule; V1 = V + constant: [2,2]."""
    det0, det1 = determinant(foot.sharp), determinant(foot.dilated)
    return adjugate(foot.sharp) / det1 - det0 / det1**2 * adjugate(foot.dilated)


def covariance_gradient(
    splats: Splats, n: int, foot: Footprint, compensate: float, grad_conic: NDArray[Any], grad_kappa: float
) -> NDArray[Any]:
    """dL/dV, [2,2], from the conic and from κ = sqrt(1 + compensate (det V / det V1 - 1))."""
    # Conic -> 2D covariance: G_V = -K G_K K (that of V itself for the pixel's box)
    a, b, c = splats.conic[n]
    conic = np.array([[a, b], [b, c]])
    ga, gb, gc = grad_conic
    grad_v = np.array([[ga, gb / 2], [gb / 2, gc]])
    if not splats.pixel_box:
        grad_v = -conic @ grad_v @ conic
    if compensate != 0:
        _, _, kappa = opacity_factors(0.0, foot, compensate)
        grad_v += grad_kappa * compensate / (2 * kappa) * ratio_gradient(foot)
    return grad_v


def project_backward(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    variance: float,
    compensate: float,
    splats: Splats,
    grad_mean2d: NDArray[Any],
    grad_conic: NDArray[Any],
    grad_opacity: NDArray[Any],
    grad_colour: NDArray[Any],
) -> dict[str, NDArray[Any]]:
    """Gradients of the parameters, named as in `PARAMETERS`; `filter_variance` is a constant.  Culled rows are zero."""
    grad = {name: np.zeros_like(getattr(gaussians, name)) for name in PARAMETERS}
    for n in np.flatnonzero(splats.visible).tolist():
        foot = footprint(gaussians, n, camera, variance)

        # Opacity o = sigmoid * ρ * κ, with the constant in ρ
        sigmoid, rho, kappa = opacity_factors(gaussians.logit_opacity[n], foot, compensate)
        rho = rho * gaussians.opacity_factor
        grad["logit_opacity"][n] = grad_opacity[n] * rho * kappa * sigmoid * (1 - sigmoid)
        grad_kappa = grad_opacity[n] * sigmoid * rho

        grad_v = covariance_gradient(splats, n, foot, compensate, grad_conic[n], grad_kappa)

        # 2D -> 3D covariance: V = M Σ Mᵀ, M = J W
        m = foot.jacobian @ camera.rotation
        grad_sigma = m.T @ grad_v @ m
        grad_j = 2 * grad_v @ m @ foot.covariance @ camera.rotation.T
        grad_point = point_gradient(camera, foot, grad_mean2d[n], grad_j)

        # Colour: SH, its direction, max(0, .)
        direction, distance = view_direction(camera, gaussians.means[n])
        not_clamped = unclamped_colour(gaussians, n, camera, degree) > 0
        grad_c = grad_colour[n] * not_clamped
        basis, basis_gradient = sh_basis(direction, degree), sh_basis_gradient(direction, degree)
        used = len(basis)
        grad["sh"][n, :used] = np.outer(basis, grad_c)
        grad_d = basis_gradient.T @ (gaussians.sh[n, :used] @ grad_c)
        grad["means"][n] = camera.rotation.T @ grad_point + (grad_d - direction * (direction @ grad_d)) / distance

        # Σ = L Lᵀ, L = R diag(s'); s' = sqrt(s² + f) also sits in ρ = Π s/s'
        grad_l = 2 * grad_sigma @ foot.rotation @ np.diag(foot.filtered)
        grad["quats"][n] = quat_gradient(gaussians.quats[n], grad_l @ np.diag(foot.filtered))
        grad_filtered = np.sum(foot.rotation * grad_l, axis=0)
        through_covariance = grad_filtered * foot.scale**2 / foot.filtered
        through_rho = grad_opacity[n] * splats.opacity[n] * gaussians.filter_variance[n] / foot.filtered**2
        grad["log_scales"][n] = through_covariance + through_rho
    return grad
