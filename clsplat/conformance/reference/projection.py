"""Project Gaussians to splats, one after another (Kerbl et al. 2023), with the filters of Yu et al. 2024."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.types import PARAMETERS, RADIUS_TILE, PinholeCamera, RawGaussians, Splats, Thresholds

# Spherical harmonics up to degree 3 in the sign convention of 3DGS, and their derivatives.


def _harmonics(x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]) -> list[tuple[Any, ...]]:
    """Return the values of the 16 harmonics and their derivatives d/dx, d/dy, and d/dz, with x, y, z independent."""
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
    d, e, f = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
    g, h = 0.3731763325901154, 1.445305721320277
    xx, yy, zz = x * x, y * y, z * z
    return [
        (c0, 0, 0, 0),
        (-c1 * y, 0, -c1, 0),
        (c1 * z, 0, 0, c1),
        (-c1 * x, -c1, 0, 0),
        (a * x * y, a * y, a * x, 0),
        (-a * y * z, 0, -a * z, -a * y),
        (b * (2 * zz - xx - yy), -2 * b * x, -2 * b * y, 4 * b * z),
        (-a * x * z, -a * z, 0, -a * x),
        (c * (xx - yy), 2 * c * x, -2 * c * y, 0),
        (-d * y * (3 * xx - yy), -6 * d * x * y, -3 * d * (xx - yy), 0),
        (e * x * y * z, e * y * z, e * x * z, e * x * y),
        (-f * y * (4 * zz - xx - yy), 2 * f * x * y, -f * (4 * zz - xx - 3 * yy), -8 * f * y * z),
        (g * z * (2 * zz - 3 * xx - 3 * yy), -6 * g * x * z, -6 * g * y * z, g * (6 * zz - 3 * xx - 3 * yy)),
        (-f * x * (4 * zz - xx - yy), -f * (4 * zz - 3 * xx - yy), 2 * f * x * y, -8 * f * x * z),
        (h * z * (xx - yy), 2 * h * x * z, -2 * h * y * z, h * (xx - yy)),
        (-d * x * (xx - 3 * yy), -3 * d * (xx - yy), 6 * d * x * y, 0),
    ]


def _harmonic_table(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """Return the values and gradients of the first (degree + 1)² harmonics, [..., K, 4]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    table = np.empty((*x.shape, (degree + 1) ** 2, 4))
    for k, row in enumerate(_harmonics(x, y, z)[: (degree + 1) ** 2]):
        for i, entry in enumerate(row):
            table[..., k, i] = entry
    return table


def sh_basis(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """Return the SH basis functions Y_k of unit directions: [..., 3] -> [..., K]."""
    return _harmonic_table(directions, degree)[..., 0]


def sh_basis_gradient(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """Return dY_k/d(x, y, z), with x, y, z independent: [..., 3] -> [..., K, 3]."""
    return _harmonic_table(directions, degree)[..., 1:]


def rotation_matrix(quat: NDArray[Any]) -> NDArray[Any]:
    """Return the rotation matrix of q/|q|: [4] -> [3, 3]."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def ray_limits(camera: PinholeCamera) -> NDArray[Any]:
    """Return the limits of x/z and y/z in the Jacobian, for any principal point: [[x_lo, x_hi], [y_lo, y_hi]]."""
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    return np.array(
        [
            [-(camera.cx / camera.fx + 0.3 * tan_x), (camera.width - camera.cx) / camera.fx + 0.3 * tan_x],
            [-(camera.cy / camera.fy + 0.3 * tan_y), (camera.height - camera.cy) / camera.fy + 0.3 * tan_y],
        ]
    )


def clamped_ray(camera: PinholeCamera, point: NDArray[Any]) -> NDArray[Any]:
    """Return x and y of a camera-space point, with the ray clamped to `ray_limits`."""
    limits = ray_limits(camera)
    return point[2] * np.clip(point[:2] / point[2], limits[:, 0], limits[:, 1])


def adjugate(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return d(det)/d(matrix) of a symmetric 2 x 2 matrix, which is its determinant times its inverse."""
    return np.array([[matrix[1, 1], -matrix[0, 1]], [-matrix[1, 0], matrix[0, 0]]])


def determinant(matrix: NDArray[Any]) -> float:
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]


@dataclass
class Footprint:
    """Intermediate values of the projection of a Gaussian's covariance, for the forward and the backward pass."""

    point: NDArray[Any]  # [3] camera space
    rotation: NDArray[Any]  # [3,3] R
    scale: NDArray[Any]  # [3] s
    filtered_scale: NDArray[Any]  # [3] s' = sqrt(s² + f)
    covariance: NDArray[Any]  # [3,3] Σ
    jacobian: NDArray[Any]  # [2,3] J
    cov2d: NDArray[Any]  # [2,2] V, before the screen filter
    filtered_cov2d: NDArray[Any]  # [2,2] V1 = V + variance I


def project_covariance(gaussians: RawGaussians, n: int, camera: PinholeCamera, variance: float) -> Footprint:
    """Project the covariance of Gaussian `n` (EWA splatting), with the 3D filter; variance: screen filter, px²."""
    point = camera.rotation @ gaussians.means[n] + camera.translation
    rotation = rotation_matrix(gaussians.quats[n])
    scale = np.exp(gaussians.log_scales[n])
    filtered_scale = np.sqrt(scale**2 + gaussians.filter_variance[n])
    covariance = rotation @ np.diag(filtered_scale**2) @ rotation.T
    (tx, ty), z = clamped_ray(camera, point), point[2]
    fx, fy = camera.fx, camera.fy
    jacobian = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
    m = jacobian @ camera.rotation
    cov2d = m @ covariance @ m.T
    filtered_cov2d = cov2d + variance * np.eye(2)
    return Footprint(point, rotation, scale, filtered_scale, covariance, jacobian, cov2d, filtered_cov2d)


def opacity_factors(logit: float, footprint: Footprint, compensate: float) -> tuple[float, float, float]:
    """Return sigmoid(logit), ρ of the 3D filter, and κ of the screen filter (1 if `compensate` is 0).

    Their product is the opacity that is blended.
    """
    ratio = max(0.0, determinant(footprint.cov2d) / determinant(footprint.filtered_cov2d))  # not -1e-17
    kappa = np.sqrt(1 + compensate * (ratio - 1))
    return 1 / (1 + np.exp(-logit)), np.prod(footprint.scale / footprint.filtered_scale), kappa


def view_direction(camera: PinholeCamera, mean: NDArray[Any]) -> tuple[NDArray[Any], Any]:
    """Return the unit vector from the camera to the Gaussian, and their distance."""
    offset = mean - camera.position
    distance = np.linalg.norm(offset)
    return offset / distance, distance


def unclamped_color(gaussians: RawGaussians, n: int, camera: PinholeCamera, degree: int) -> NDArray[Any]:
    """Return the color of Gaussian `n` before negative values are clamped, Σ Y_k(d) c_k + 0.5, [3]."""
    basis = sh_basis(view_direction(camera, gaussians.means[n])[0], degree)
    return basis @ gaussians.sh[n, : len(basis)] + 0.5


def vanilla_radius(mean2d: NDArray[Any], cov2d: NDArray[Any], width: int, height: int) -> float:
    """Return the radius of 3DGS, three standard deviations in px, or 0 if the splat reaches no tile."""
    mean_variance = (cov2d[0, 0] + cov2d[1, 1]) / 2
    max_variance = mean_variance + np.sqrt(max(0.1, mean_variance**2 - determinant(cov2d)))
    radius = np.ceil(3 * np.sqrt(max_variance))
    index = mean2d - 0.5  # the reference implementation counts pixels from their centers
    grid = np.ceil(np.array([width, height]) / RADIUS_TILE)
    first = np.clip(np.trunc((index - radius) / RADIUS_TILE), 0, grid)
    last = np.clip(np.trunc((index + radius + RADIUS_TILE - 1) / RADIUS_TILE), 0, grid)
    return radius if np.all(first < last) else 0.0


def project(
    gaussians: RawGaussians,
    camera: PinholeCamera,
    degree: int,
    near: float = 0.2,
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: Thresholds = Thresholds(),
    pixel_box: float = 0.0,
) -> Splats:
    """Project Gaussians to splats.

    degree: active degree of the harmonics.  variance: of the screen filter, px².  compensate: 1 if the screen filter
    scales opacities by κ, else 0.  pixel_box: 1 to integrate splats over the box of each pixel; this requires
    `variance` and `compensate` to be 0.
    """
    count = len(gaussians.means)
    splats = Splats(
        mean2d=np.zeros((count, 2)),
        conic=np.zeros((count, 3)),
        opacity=np.zeros(count),
        color=np.zeros((count, 3)),
        depth=np.zeros(count),
        radius=np.zeros(count),
        visible=np.zeros(count, bool),
        pixel_box=bool(pixel_box),
    )
    for n in range(count):
        z = camera.rotation[2] @ gaussians.means[n] + camera.translation[2]
        if not z >= near or np.sum(gaussians.quats[n] ** 2) < 1e-12:
            continue
        footprint = project_covariance(gaussians, n, camera, variance)
        det = determinant(cov2d := footprint.filtered_cov2d)
        if not det > 0:
            continue
        x, y, z = footprint.point
        mean2d = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        splats.radius[n] = vanilla_radius(mean2d, cov2d, camera.width, camera.height)
        opacity = gaussians.opacity_factor * np.prod(opacity_factors(gaussians.logit_opacity[n], footprint, compensate))
        max_alpha = opacity * min(1, 2 * np.pi * np.sqrt(det)) if pixel_box else opacity
        if not max_alpha > thresholds.alpha_min:
            continue
        splats.visible[n] = True
        splats.mean2d[n] = mean2d
        splats.conic[n] = np.array([cov2d[1, 1], -cov2d[0, 1], cov2d[0, 0]]) / det
        if pixel_box:
            splats.conic[n] = footprint.cov2d[0, 0], footprint.cov2d[0, 1], footprint.cov2d[1, 1]
        splats.opacity[n] = opacity
        splats.color[n] = np.maximum(0, unclamped_color(gaussians, n, camera, degree))
        splats.depth[n] = z
    return splats


# Gradients of the projection, one Gaussian after another.


def quat_gradient(quat: NDArray[Any], h: NDArray[Any]) -> NDArray[Any]:
    """Return dL/dq of a quaternion that is not normalized, [4], from H = dL/dR, [3, 3]."""
    norm = np.linalg.norm(quat)
    unit = quat / norm
    w, x, y, z = unit
    gw = 2 * (z * (h[1, 0] - h[0, 1]) + y * (h[0, 2] - h[2, 0]) + x * (h[2, 1] - h[1, 2]))
    gx = 2 * (y * (h[0, 1] + h[1, 0]) + z * (h[0, 2] + h[2, 0]) + w * (h[2, 1] - h[1, 2]) - 2 * x * (h[1, 1] + h[2, 2]))
    gy = 2 * (x * (h[0, 1] + h[1, 0]) + z * (h[1, 2] + h[2, 1]) + w * (h[0, 2] - h[2, 0]) - 2 * y * (h[0, 0] + h[2, 2]))
    gz = 2 * (x * (h[0, 2] + h[2, 0]) + y * (h[1, 2] + h[2, 1]) + w * (h[1, 0] - h[0, 1]) - 2 * z * (h[0, 0] + h[1, 1]))
    grad_unit = np.array([gw, gx, gy, gz])
    return (grad_unit - unit * (unit @ grad_unit)) / norm


def point_gradient(
    camera: PinholeCamera, footprint: Footprint, grad_mean2d: NDArray[Any], grad_j: NDArray[Any]
) -> NDArray[Any]:
    """Return dL/d(camera-space point), [3], through the screen position and the Jacobian J with its clamped ray."""
    x, y, z = footprint.point
    fx, fy = camera.fx, camera.fy
    gu, gv = grad_mean2d
    gx, gy = fx / z * gu, fy / z * gv
    gz = -(fx * x * gu + fy * y * gv) / z**2 - fx / z**2 * grad_j[0, 0] - fy / z**2 * grad_j[1, 1]
    tx, ty = clamped_ray(camera, footprint.point)
    (x_low, x_high), (y_low, y_high) = ray_limits(camera)
    if x_low <= x / z <= x_high:
        gx += -fx / z**2 * grad_j[0, 2]
        gz += 2 * fx * x / z**3 * grad_j[0, 2]
    else:  # tx = limit * z, so J02 is proportional to 1/z and independent of x
        gz += fx * tx / z**3 * grad_j[0, 2]
    if y_low <= y / z <= y_high:
        gy += -fy / z**2 * grad_j[1, 2]
        gz += 2 * fy * y / z**3 * grad_j[1, 2]
    else:
        gz += fy * ty / z**3 * grad_j[1, 2]
    return np.array([gx, gy, gz])


def ratio_gradient(footprint: Footprint) -> NDArray[Any]:
    """Return d(det V / det V1)/dV, [2, 2], where V1 is V plus a constant."""
    det0, det1 = determinant(footprint.cov2d), determinant(footprint.filtered_cov2d)
    return adjugate(footprint.cov2d) / det1 - det0 / det1**2 * adjugate(footprint.filtered_cov2d)


def covariance_gradient(
    splats: Splats, n: int, footprint: Footprint, compensate: float, grad_conic: NDArray[Any], grad_kappa: float
) -> NDArray[Any]:
    """Return dL/dV, [2, 2], from the gradients of the conic and of κ = sqrt(1 + compensate (det V / det V1 - 1))."""
    # Conic -> 2D covariance: G_V = -K G_K K (for the pixel's box, V is given directly)
    a, b, c = splats.conic[n]
    conic = np.array([[a, b], [b, c]])
    ga, gb, gc = grad_conic
    grad_v = np.array([[ga, gb / 2], [gb / 2, gc]])
    if not splats.pixel_box:
        grad_v = -conic @ grad_v @ conic
    if compensate != 0:
        _, _, kappa = opacity_factors(0.0, footprint, compensate)
        grad_v += grad_kappa * compensate / (2 * kappa) * ratio_gradient(footprint)
    return grad_v


def project_backward(
    gaussians: RawGaussians,
    camera: PinholeCamera,
    degree: int,
    variance: float,
    compensate: float,
    splats: Splats,
    grad_mean2d: NDArray[Any],
    grad_conic: NDArray[Any],
    grad_opacity: NDArray[Any],
    grad_color: NDArray[Any],
) -> dict[str, NDArray[Any]]:
    """Return the gradients of `PARAMETERS` by name, zero for culled Gaussians; `filter_variance` is held constant."""
    grad = {name: np.zeros_like(getattr(gaussians, name)) for name in PARAMETERS}
    for n in np.flatnonzero(splats.visible).tolist():
        footprint = project_covariance(gaussians, n, camera, variance)

        # Opacity o = sigmoid * ρ * κ, with the constant in ρ
        sigmoid, rho, kappa = opacity_factors(gaussians.logit_opacity[n], footprint, compensate)
        rho = rho * gaussians.opacity_factor
        grad["logit_opacity"][n] = grad_opacity[n] * rho * kappa * sigmoid * (1 - sigmoid)
        grad_kappa = grad_opacity[n] * sigmoid * rho

        grad_v = covariance_gradient(splats, n, footprint, compensate, grad_conic[n], grad_kappa)

        # 2D -> 3D covariance: V = M Σ Mᵀ, M = J W
        m = footprint.jacobian @ camera.rotation
        grad_sigma = m.T @ grad_v @ m
        grad_j = 2 * grad_v @ m @ footprint.covariance @ camera.rotation.T
        grad_point = point_gradient(camera, footprint, grad_mean2d[n], grad_j)

        # Color: SH, its direction, max(0, .)
        direction, distance = view_direction(camera, gaussians.means[n])
        is_unclamped = unclamped_color(gaussians, n, camera, degree) > 0
        grad_c = grad_color[n] * is_unclamped
        basis, basis_gradient = sh_basis(direction, degree), sh_basis_gradient(direction, degree)
        k = len(basis)
        grad["sh"][n, :k] = np.outer(basis, grad_c)
        grad_d = basis_gradient.T @ (gaussians.sh[n, :k] @ grad_c)
        grad["means"][n] = camera.rotation.T @ grad_point + (grad_d - direction * (direction @ grad_d)) / distance

        # Σ = L Lᵀ, L = R diag(s'); s' = sqrt(s² + f) is also part of ρ = Π s/s'
        grad_l = 2 * grad_sigma @ footprint.rotation @ np.diag(footprint.filtered_scale)
        grad["quats"][n] = quat_gradient(gaussians.quats[n], grad_l @ np.diag(footprint.filtered_scale))
        grad_filtered = np.sum(footprint.rotation * grad_l, axis=0)
        through_covariance = grad_filtered * footprint.scale**2 / footprint.filtered_scale
        through_rho = grad_opacity[n] * splats.opacity[n] * gaussians.filter_variance[n] / footprint.filtered_scale**2
        grad["log_scales"][n] = through_covariance + through_rho
    return grad


# The 3D filter: the sampling interval of each Gaussian (Yu et al. 2024, 5.1).


def sampling_interval(
    means: NDArray[Any],
    cameras: list[PinholeCamera],
    focal_lengths: list[float],
    near: float = 0.2,
    margin: float = 0.15,
) -> NDArray[Any]:
    """Return the smallest depth / focal length over the cameras in which each mean is visible, [N].

    Means that no camera sees get the largest interval of the other means.
    """
    intervals = np.full(len(means), np.inf)
    for n, mean in enumerate(means):
        for camera, focal in zip(cameras, focal_lengths, strict=True):
            x, y, z = camera.rotation @ mean + camera.translation
            if not z > near:
                continue
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if (
                -margin * camera.width <= u <= (1 + margin) * camera.width
                and -margin * camera.height <= v <= (1 + margin) * camera.height
            ):
                intervals[n] = min(intervals[n], z / focal)
    is_visible = np.isfinite(intervals)
    intervals[~is_visible] = intervals[is_visible].max(initial=0)
    return intervals


# Gradients of the pose and the focal length of a camera, one Gaussian after another, in camera axes.


def move_camera(camera: PinholeCamera, shift: NDArray[Any], rotvec: NDArray[Any], zoom: float = 0.0) -> PinholeCamera:
    """Return the camera with W' = R W, t' = R t + shift, R = exp([rotvec]x), and focal lengths times exp(zoom)."""
    angle = np.linalg.norm(rotvec)
    x, y, z = rotvec
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3)
    if angle > 0:
        rotation = rotation + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    pose = rotation @ camera.world_to_camera
    pose[:, 3] += shift
    fx, fy = np.exp(zoom) * camera.fx, np.exp(zoom) * camera.fy
    return PinholeCamera(pose, fx, fy, camera.cx, camera.cy, camera.width, camera.height)


def pose_gradient(
    gaussians: RawGaussians,
    camera: PinholeCamera,
    degree: int,
    variance: float,
    compensate: float,
    splats: Splats,
    grad_mean2d: NDArray[Any],
    grad_conic: NDArray[Any],
    grad_opacity: NDArray[Any],
    grad_color: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return dL/d(shift) and dL/d(rotvec), each [3], and dL/d(zoom), [1], of `move_camera` at zero."""
    grad_shift, grad_rotvec, grad_zoom = np.zeros(3), np.zeros(3), np.zeros(1)
    for n in np.flatnonzero(splats.visible).tolist():
        footprint = project_covariance(gaussians, n, camera, variance)
        sigmoid, rho, _ = opacity_factors(gaussians.logit_opacity[n], footprint, compensate)
        grad_kappa = grad_opacity[n] * sigmoid * rho * gaussians.opacity_factor
        grad_v = covariance_gradient(splats, n, footprint, compensate, grad_conic[n], grad_kappa)
        g = 2 * grad_v @ footprint.jacobian @ camera.rotation @ footprint.covariance @ camera.rotation.T
        grad_point = point_gradient(camera, footprint, grad_mean2d[n], g)

        # x_c' = exp([rotvec]x) x_c + shift, and M = J W: dL/d(rotvec) = <G_J, J [rotvec]x>
        j = footprint.jacobian
        grad_rotvec += np.cross(footprint.point, grad_point)
        grad_rotvec += [
            j[0, 2] * g[0, 1] + j[1, 2] * g[1, 1] - j[1, 1] * g[1, 2],
            j[0, 0] * g[0, 2] - j[0, 2] * g[0, 0] - j[1, 2] * g[1, 0],
            j[1, 1] * g[1, 0] - j[0, 0] * g[0, 1],
        ]

        # The viewing direction depends only on the shift
        direction, distance = view_direction(camera, gaussians.means[n])
        grad_c = grad_color[n] * (unclamped_color(gaussians, n, camera, degree) > 0)
        basis_gradient = sh_basis_gradient(direction, degree)
        grad_d = basis_gradient.T @ (gaussians.sh[n, : len(basis_gradient)] @ grad_c)
        grad_shift += grad_point + camera.rotation @ (grad_d - direction * (direction @ grad_d)) / distance
        grad_zoom += camera.fx * focal_gradient(camera, footprint, grad_mean2d[n], g, 0)
        grad_zoom += camera.fy * focal_gradient(camera, footprint, grad_mean2d[n], g, 1)
    return grad_shift, grad_rotvec, grad_zoom


def focal_gradient(
    camera: PinholeCamera, footprint: Footprint, grad_mean2d: NDArray[Any], grad_j: NDArray[Any], axis: int
) -> float:
    """Return dL/dfx (axis 0) or dL/dfy (axis 1), through the screen position and the Jacobian J.

    The limits of rays are proportional to 1/f, so J02 = -f limit/z of a clamped ray does not depend on f.
    """
    z = footprint.point[2]
    ray = footprint.point[axis] / z
    low, high = ray_limits(camera)[axis]
    is_inside = low <= ray <= high
    return float(grad_mean2d[axis] * ray + grad_j[axis, axis] / z - (ray / z * grad_j[axis, 2] if is_inside else 0.0))
