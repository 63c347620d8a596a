"""The oracle: 3D Gaussian splatting and its gradients in float64 NumPy, written to be read, not to be fast.

Kerbl et al. 2023 (3DGS), with the filters of Yu et al. 2024 (Mip-Splatting).  Projection handles one Gaussian at a
time; blending is in `reference_blend.py`, losses, the optimizer and density control in `reference_loss.py`.

Conventions: OpenCV camera (x right, y down, z forward); the centre of pixel (0, 0) is (0.5, 0.5); quaternions are
(w, x, y, z); `grad_x` is dL/dx.  Letters: N Gaussians, K harmonics, C = 3 channels, H, W image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh")
RADIUS_TILE = 16  # px; the tile of the vanilla visibility test, whatever tile the kernels use


@dataclass(frozen=True)
class Thresholds:
    """The three constants of 2.3.  With `SMOOTH` nothing is skipped, so that the image is differentiable."""

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4


SMOOTH = Thresholds(alpha_min=0.0, transmittance_min=0.0)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera; `fx, fy, cx, cy` in px."""

    world_to_camera: np.ndarray  # [3,4]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def rotation(self) -> np.ndarray:
        return self.world_to_camera[:, :3]

    @property
    def translation(self) -> np.ndarray:
        return self.world_to_camera[:, 3]

    @property
    def position(self) -> np.ndarray:
        return -self.rotation.T @ self.translation


@dataclass
class Gaussians:
    """Raw parameters, as optimised."""

    means: np.ndarray  # [N,3]
    quats: np.ndarray  # [N,4] w, x, y, z; not normalised
    log_scales: np.ndarray  # [N,3]
    logit_opacity: np.ndarray  # [N]
    sh: np.ndarray  # [N,K,3]
    filter_variance: np.ndarray | None = None  # [N] scene units²; zeros when not given

    def __post_init__(self) -> None:
        if self.filter_variance is None:
            self.filter_variance = np.zeros(len(self.means))
        for name in (*PARAMETERS, "filter_variance"):
            setattr(self, name, np.array(getattr(self, name), np.float64))


@dataclass
class Splats:
    """Projected Gaussians.  Rows that are not visible are zero, except for their radius."""

    mean2d: np.ndarray  # [N,2] px
    conic: np.ndarray  # [N,3] A, B, C = xx, xy, yy of the inverse covariance
    opacity: np.ndarray  # [N] after both filters
    colour: np.ndarray  # [N,3]
    depth: np.ndarray  # [N] z
    radius: np.ndarray  # [N] px, whole; 0 = not visible to density control; independent of opacity
    visible: np.ndarray  # [N] bool: blended


class SplatGradients(NamedTuple):
    """What `blend_backward` returns."""

    mean2d: np.ndarray  # [N,2]
    conic: np.ndarray  # [N,3] with respect to the scalars A, B, C
    opacity: np.ndarray  # [N]
    colour: np.ndarray  # [N,3]
    mean2d_abs: np.ndarray  # [N,2] sum over pixels of |dL/du|, |dL/dv|


# ---- Spherical harmonics -------------------------------------------------------------------------------------------


def _harmonics(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> list[tuple]:
    """The 16 rows (value, d/dx, d/dy, d/dz), treating x, y, z as free."""
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


def _harmonic_table(directions: np.ndarray, degree: int) -> np.ndarray:
    """Value and gradient of the first (degree+1)² harmonics: [..., K, 4]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    rows = _harmonics(x, y, z)[: (degree + 1) ** 2]
    return np.stack([np.stack([entry + np.zeros_like(x) for entry in row], axis=-1) for row in rows], axis=-2)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Y_k of unit directions: [..., 3] -> [..., K]."""
    return _harmonic_table(directions, degree)[..., 0]


def sh_basis_gradient(directions: np.ndarray, degree: int) -> np.ndarray:
    """dY_k/d(x, y, z), as polynomials of free x, y, z: [..., 3] -> [..., K, 3]."""
    return _harmonic_table(directions, degree)[..., 1:]


# ---- Projection ----------------------------------------------------------------------------------------------------


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """R of q/|q|: [4] -> [3,3]."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def ray_limits(camera: Camera) -> np.ndarray:
    """Limits of x/z and y/z in the Jacobian, for any principal point: [[x_lo, x_hi], [y_lo, y_hi]]."""
    tan_x, tan_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    return np.array(
        [
            [-(camera.cx / camera.fx + 0.3 * tan_x), (camera.width - camera.cx) / camera.fx + 0.3 * tan_x],
            [-(camera.cy / camera.fy + 0.3 * tan_y), (camera.height - camera.cy) / camera.fy + 0.3 * tan_y],
        ]
    )


def clamped_ray(camera: Camera, point: np.ndarray) -> np.ndarray:
    """(tx, ty) of 2.1 step 3 for a camera-space point."""
    limits = ray_limits(camera)
    return point[2] * np.clip(point[:2] / point[2], limits[:, 0], limits[:, 1])


def adjugate(matrix: np.ndarray) -> np.ndarray:
    """d(det)/d(matrix) of a symmetric 2x2 matrix, which is det * inverse."""
    return np.array([[matrix[1, 1], -matrix[0, 1]], [-matrix[1, 0], matrix[0, 0]]])


def determinant(matrix: np.ndarray) -> float:
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]


@dataclass
class Footprint:
    """Everything between the parameters of one Gaussian and its covariance on the screen; used by both directions."""

    point: np.ndarray  # [3] camera space
    rotation: np.ndarray  # [3,3] R
    scale: np.ndarray  # [3] s
    filtered: np.ndarray  # [3] s' = sqrt(s² + f)
    covariance: np.ndarray  # [3,3] Σ
    jacobian: np.ndarray  # [2,3] J
    sharp: np.ndarray  # [2,2] V, before the screen filter
    dilated: np.ndarray  # [2,2] V1 = V + variance I


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


def view_direction(camera: Camera, mean: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit vector from the camera to the Gaussian, and their distance."""
    offset = mean - camera.position
    distance = np.linalg.norm(offset)
    return offset / distance, distance


def unclamped_colour(gaussians: Gaussians, n: int, camera: Camera, degree: int) -> np.ndarray:
    """Σ Y_k(d) c_k + 0.5: [3]."""
    basis = sh_basis(view_direction(camera, gaussians.means[n])[0], degree)
    return basis @ gaussians.sh[n, : len(basis)] + 0.5


def vanilla_radius(mean2d: np.ndarray, dilated: np.ndarray, width: int, height: int) -> float:
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
) -> Splats:
    """Project Gaussians; `degree` is the active one, `variance` (px²) and `compensate` (0 or 1) the screen filter."""
    count = len(gaussians.means)
    splats = Splats(
        mean2d=np.zeros((count, 2)),
        conic=np.zeros((count, 3)),
        opacity=np.zeros(count),
        colour=np.zeros((count, 3)),
        depth=np.zeros(count),
        radius=np.zeros(count),
        visible=np.zeros(count, bool),
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
        opacity = np.prod(opacity_factors(gaussians.logit_opacity[n], foot, compensate))
        if not opacity > thresholds.alpha_min:
            continue
        splats.visible[n] = True
        splats.mean2d[n] = mean2d
        splats.conic[n] = np.array([foot.dilated[1, 1], -foot.dilated[0, 1], foot.dilated[0, 0]]) / det
        splats.opacity[n] = opacity
        splats.colour[n] = np.maximum(0, unclamped_colour(gaussians, n, camera, degree))
        splats.depth[n] = z
    return splats


# ---- Projection, backwards -----------------------------------------------------------------------------------------


def quat_gradient(quat: np.ndarray, h: np.ndarray) -> np.ndarray:
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


def point_gradient(camera: Camera, foot: Footprint, grad_mean2d: np.ndarray, grad_j: np.ndarray) -> np.ndarray:
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


def ratio_gradient(foot: Footprint) -> np.ndarray:
    """d(det V / det V1)/dV, by the quotient rule; V1 = V + constant: [2,2]."""
    det0, det1 = determinant(foot.sharp), determinant(foot.dilated)
    return adjugate(foot.sharp) / det1 - det0 / det1**2 * adjugate(foot.dilated)


def project_backward(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    variance: float,
    compensate: float,
    splats: Splats,
    grad_mean2d: np.ndarray,
    grad_conic: np.ndarray,
    grad_opacity: np.ndarray,
    grad_colour: np.ndarray,
) -> dict[str, np.ndarray]:
    """Gradients of the parameters, named as in `PARAMETERS`; `filter_variance` is a constant.  Culled rows are zero."""
    grad = {name: np.zeros_like(getattr(gaussians, name)) for name in PARAMETERS}
    for n in np.flatnonzero(splats.visible):
        foot = footprint(gaussians, n, camera, variance)

        # Opacity o = sigmoid * ρ * κ
        sigmoid, rho, kappa = opacity_factors(gaussians.logit_opacity[n], foot, compensate)
        grad["logit_opacity"][n] = grad_opacity[n] * rho * kappa * sigmoid * (1 - sigmoid)
        grad_kappa = grad_opacity[n] * sigmoid * rho

        # Conic -> 2D covariance: G_V = -K G_K K; then κ = sqrt(1 + compensate (det V / det V1 - 1))
        a, b, c = splats.conic[n]
        conic = np.array([[a, b], [b, c]])
        ga, gb, gc = grad_conic[n]
        grad_v = -conic @ np.array([[ga, gb / 2], [gb / 2, gc]]) @ conic
        if compensate != 0:
            grad_v += grad_kappa * compensate / (2 * kappa) * ratio_gradient(foot)

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
