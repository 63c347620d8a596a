"""Projection of Gaussians to splats, one Gaussian at a time (Kerbl et al. 2023), with the filters of Yu et al. 2024."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.harmonics import sh_basis
from clsplat.conformance.reference.kinds import RADIUS_TILE, Camera, Gaussians, Splats, Thresholds


def rotation_matrix(quat: NDArray[Any]) -> NDArray[Any]:
    """R of q/|q|: [4] -> [3,3]."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def ray_limits(camera: Camera) -> NDArray[Any]:
    """Limits of x/z and y/z in the Jacobian, for any principal point: [[x_lo, x_hi], [y_lo, y_hi]]."""
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    return np.array(
        [
            [-(camera.cx / camera.fx + 0.3 * tan_x), (camera.width - camera.cx) / camera.fx + 0.3 * tan_x],
            [-(camera.cy / camera.fy + 0.3 * tan_y), (camera.height - camera.cy) / camera.fy + 0.3 * tan_y],
        ]
    )


def clamped_ray(camera: Camera, point: NDArray[Any]) -> NDArray[Any]:
    """(tx, ty) of 2.1 step 3 for a camera-space point."""
    limits = ray_limits(camera)
    return point[2] * np.clip(point[:2] / point[2], limits[:, 0], limits[:, 1])


def adjugate(matrix: NDArray[Any]) -> NDArray[Any]:
    """d(det)/d(matrix) of a symmetric 2x2 matrix, which is det * inverse."""
    return np.array([[matrix[1, 1], -matrix[0, 1]], [-matrix[1, 0], matrix[0, 0]]])


def determinant(matrix: NDArray[Any]) -> float:
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]


@dataclass
class Footprint:
    """Everything between the parameters of one Gaussian and its covariance on the screen; used by both directions."""

    point: NDArray[Any]  # [3] camera space
    rotation: NDArray[Any]  # [3,3] R
    scale: NDArray[Any]  # [3] s
    filtered: NDArray[Any]  # [3] s' = sqrt(s² + f)
    covariance: NDArray[Any]  # [3,3] Σ
    jacobian: NDArray[Any]  # [2,3] J
    sharp: NDArray[Any]  # [2,2] V, before the screen filter
    dilated: NDArray[Any]  # [2,2] V1 = V + variance I


def footprint(gaussians: Gaussians, n: int, camera: Camera, variance: float) -> Footprint:
    """2.1 steps 1-4 with the world filter of 8.1."""
    point = camera.rotation @ gaussians.means[n] + camera.translation
    rotation = rotation_matrix(gaussians.quats[n])
    scale = np.exp(gaussians.log_scales[n])
    filtered = np.sqrt(scale**2 + gaussians.filter_variance[n])
    covariance = rotation @ np.diag(filtered**2) @ rotation.T
    (tx, ty), z = clamped_ray(camera, point), point[2]
    fx, fy = camera.fx, camera.fy
    jacobian = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
    m = jacobian @ camera.rotation
    sharp = m @ covariance @ m.T
    dilated = sharp + variance * np.eye(2)
    return Footprint(point, rotation, scale, filtered, covariance, jacobian, sharp, dilated)


def opacity_factors(logit: float, foot: Footprint, compensate: float) -> tuple[float, float, float]:
    """sigmoid(a), ρ of 8.1, κ of 8.2 (1 where `compensate` is 0); their product is what is blended."""
    ratio = max(0.0, determinant(foot.sharp) / determinant(foot.dilated))  # rounding may give -1e-17
    kappa = np.sqrt(1 + compensate * (ratio - 1))
    return 1 / (1 + np.exp(-logit)), np.prod(foot.scale / foot.filtered), kappa


def view_direction(camera: Camera, mean: NDArray[Any]) -> tuple[NDArray[Any], Any]:
    """Unit vector from the camera to the Gaussian, and their distance."""
    offset = mean - camera.position
    distance = np.linalg.norm(offset)
    return offset / distance, distance


def unclamped_colour(gaussians: Gaussians, n: int, camera: Camera, degree: int) -> NDArray[Any]:
    """Σ Y_k(d) c_k + 0.5: [3]."""
    basis = sh_basis(view_direction(camera, gaussians.means[n])[0], degree)
    return basis @ gaussians.sh[n, : len(basis)] + 0.5


def vanilla_radius(mean2d: NDArray[Any], dilated: NDArray[Any], width: int, height: int) -> float:
    """Radius of 2.1 step 6, or 0 if the rectangle of step 8 is empty."""
    middle = (dilated[0, 0] + dilated[1, 1]) / 2
    largest = middle + np.sqrt(max(0.1, middle**2 - determinant(dilated)))
    radius = np.ceil(3 * np.sqrt(largest))
    index = mean2d - 0.5  # the reference implementation counts pixels from their centres
    grid = np.ceil(np.array([width, height]) / RADIUS_TILE)
    first = np.clip(np.trunc((index - radius) / RADIUS_TILE), 0, grid)
    last = np.clip(np.trunc((index + radius + RADIUS_TILE - 1) / RADIUS_TILE), 0, grid)
    return radius if np.all(first < last) else 0.0


def project(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    near: float = 0.2,
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: Thresholds = Thresholds(),
    pixel_box: float = 0.0,
) -> Splats:
    """Project Gaussians; `degree` is the active one, `variance` (px²) and `compensate` (0 or 1) the screen filter.

    pixel_box: 1, with neither of them, where splats are integrated over the pixel's box.
    """
    count = len(gaussians.means)
    splats = Splats(
        mean2d=np.zeros((count, 2)),
        conic=np.zeros((count, 3)),
        opacity=np.zeros(count),
        colour=np.zeros((count, 3)),
        depth=np.zeros(count),
        radius=np.zeros(count),
        visible=np.zeros(count, bool),
        pixel_box=bool(pixel_box),
    )
    for n in range(count):
        z = camera.rotation[2] @ gaussians.means[n] + camera.translation[2]
        if not z >= near or np.sum(gaussians.quats[n] ** 2) < 1e-12:
            continue
        foot = footprint(gaussians, n, camera, variance)
        det = determinant(foot.dilated)
        if not det > 0:
            continue
        x, y, z = foot.point
        mean2d = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        splats.radius[n] = vanilla_radius(mean2d, foot.dilated, camera.width, camera.height)
        opacity = gaussians.opacity_factor * np.prod(opacity_factors(gaussians.logit_opacity[n], foot, compensate))
        brightest = opacity * min(1, 2 * np.pi * np.sqrt(det)) if pixel_box else opacity
        if not brightest > thresholds.alpha_min:
            continue
        splats.visible[n] = True
        splats.mean2d[n] = mean2d
        splats.conic[n] = np.array([foot.dilated[1, 1], -foot.dilated[0, 1], foot.dilated[0, 0]]) / det
        if pixel_box:
            splats.conic[n] = foot.sharp[0, 0], foot.sharp[0, 1], foot.sharp[1, 1]
        splats.opacity[n] = opacity
        splats.colour[n] = np.maximum(0, unclamped_colour(gaussians, n, camera, degree))
        splats.depth[n] = z
    return splats
