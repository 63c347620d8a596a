"""Gradients by the place and the focal length of a camera, one Gaussian at a time, in the axes of the camera."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.harmonics import sh_basis_gradient
from clsplat.conformance.reference.kinds import Camera, Gaussians, Splats
from clsplat.conformance.reference.projection import (
    Footprint,
    footprint,
    opacity_factors,
    ray_limits,
    unclamped_colour,
    view_direction,
)
from clsplat.conformance.reference.projection_backward import covariance_gradient, point_gradient


def moved_camera(camera: Camera, shift: NDArray[Any], turn: NDArray[Any], zoom: float = 0.0) -> Camera:
    """The camera after W' = exp([turn]x) W, t' = exp([turn]x) t + shift, and focal lengths times exp(zoom)."""
    angle = np.linalg.norm(turn)
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3)
    if angle > 0:
        rotation = rotation + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    pose = rotation @ camera.world_to_camera
    pose[:, 3] += shift
    fx, fy = np.exp(zoom) * camera.fx, np.exp(zoom) * camera.fy
    return Camera(pose, fx, fy, camera.cx, camera.cy, camera.width, camera.height)


def pose_gradient(
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
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """dL/d(shift) and dL/d(turn), each [3], and dL/d(zoom), [1], of `moved_camera` at zero."""
    shift, turn, zoom = np.zeros(3), np.zeros(3), np.zeros(1)
    for n in np.flatnonzero(splats.visible).tolist():
        foot = footprint(gaussians, n, camera, variance)
        sigmoid, rho, _ = opacity_factors(gaussians.logit_opacity[n], foot, compensate)
        grad_kappa = grad_opacity[n] * sigmoid * rho * gaussians.opacity_factor
        grad_v = covariance_gradient(splats, n, foot, compensate, grad_conic[n], grad_kappa)
        g = 2 * grad_v @ foot.jacobian @ camera.rotation @ foot.covariance @ camera.rotation.T
        grad_point = point_gradient(camera, foot, grad_mean2d[n], g)

        # x_c' = exp([turn]x) x_c + shift, and M = J W: dL/d(turn) = <G_J, J [turn]x>
        j = foot.jacobian
        turn += np.cross(foot.point, grad_point)
        turn += [
            j[0, 2] * g[0, 1] + j[1, 2] * g[1, 1] - j[1, 1] * g[1, 2],
            j[0, 0] * g[0, 2] - j[0, 2] * g[0, 0] - j[1, 2] * g[1, 0],
            j[1, 1] * g[1, 0] - j[0, 0] * g[0, 1],
        ]

        # The direction of view changes with the shift alone
        direction, distance = view_direction(camera, gaussians.means[n])
        grad_c = grad_colour[n] * (unclamped_colour(gaussians, n, camera, degree) > 0)
        basis_gradient = sh_basis_gradient(direction, degree)
        grad_d = basis_gradient.T @ (gaussians.sh[n, : len(basis_gradient)] @ grad_c)
        shift += grad_point + camera.rotation @ (grad_d - direction * (direction @ grad_d)) / distance
        zoom += camera.fx * focal_gradient(camera, foot, grad_mean2d[n], g, 0)
        zoom += camera.fy * focal_gradient(camera, foot, grad_mean2d[n], g, 1)
    return shift, turn, zoom


def focal_gradient(
    camera: Camera, foot: Footprint, grad_mean2d: NDArray[Any], grad_j: NDArray[Any], axis: int
) -> float:
    """dL/dfx (axis 0) or dL/dfy (1), through the screen position and through J.

    Limits of rays go like 1/f, so that J02 = -f limit/z of a clamped one does not change with f.
    """
    z = foot.point[2]
    ray = foot.point[axis] / z
    low, high = ray_limits(camera)[axis]
    free = low <= ray <= high
    return float(grad_mean2d[axis] * ray + grad_j[axis, axis] / z - (ray / z * grad_j[axis, 2] if free else 0.0))
