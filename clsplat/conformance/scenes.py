"""Generate small random scenes for the kernels and the reference."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.conformance import reference as ref
from clsplat.conformance.reference import Splats
from clsplat.gaussians.gaussians import DeviceModel, DropoutMask, Gaussians
from clsplat.opencl.device import Device
from clsplat.render.camera import DeviceCamera, upload_camera
from clsplat.scene.camera import Camera
from clsplat.scene.view import View

SHARP_THRESHOLDS = ref.Thresholds()
POSE = np.array([[0.98, 0.05, -0.19, 0.1], [-0.03, 0.995, 0.1, -0.05], [0.19, -0.09, 0.977, 0.3]])


@dataclass(frozen=True)
class Case:
    """N Gaussians in front of a camera.  Values are float32, so that kernels and reference use the same values."""

    parameters: dict[str, NDArray[Any]]  # [N, components] float32
    view: View
    degree: int = 3
    near: float = 0.2
    variance: float = 0.3  # px², of the screen filter
    compensate: float = 0.0  # 1: the screen filter preserves the brightness of small splats
    pixel_box: float = 0.0  # 1: the box filter, with a variance of 0
    dropout: DropoutMask | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.view.camera.width, self.view.camera.height

    def model(self, device: Device) -> DeviceModel:
        gaussians = Gaussians(device, self.parameters)
        settings = self.near, self.variance, self.compensate, self.pixel_box
        return DeviceModel(gaussians, self.degree, *settings, self.dropout)

    def device_camera(self, device: Device) -> DeviceCamera:
        return upload_camera(device, self.view)

    def gaussians(self) -> ref.RawGaussians:
        p = {name: table.astype(np.float64) for name, table in self.parameters.items()}
        sh = np.concatenate([p["sh_base"], p["sh_rest"]], axis=1).reshape(len(p["means"]), 16, 3)
        filters = p.get("filter_variance")
        return ref.RawGaussians(
            p["means"],
            p["quats"],
            p["log_scales"],
            p["logit_opacity"][:, 0],
            sh,
            np.zeros(0) if filters is None else filters[:, 0],
            self.dropout.opacity_factor if self.dropout else 1.0,
        )

    def camera(self) -> ref.PinholeCamera:
        c = self.view.camera
        pose = self.view.world_to_camera.astype(np.float32).astype(np.float64)
        fx, fy, cx, cy = (float(np.float32(value)) for value in (c.fx, c.fy, c.cx, c.cy))
        return ref.PinholeCamera(pose, fx, fy, cx, cy, c.width, c.height)

    def projection_settings(self) -> dict[str, float]:
        settings = {"near": self.near, "variance": self.variance, "compensate": self.compensate}
        return settings | {"pixel_box": self.pixel_box}

    def project(self, thresholds: ref.Thresholds = SHARP_THRESHOLDS) -> ref.Splats:
        settings = self.projection_settings()
        splats = ref.project(self.gaussians(), self.camera(), self.degree, **settings, thresholds=thresholds)
        if self.dropout:
            drop_mask = ref.drop_mask(**vars(self.dropout), count=len(splats.visible))
            for values in (values for values in vars(splats).values() if isinstance(values, np.ndarray)):
                values[drop_mask] = 0
        return splats


def random_case(rng: np.random.Generator, count: int, width: int = 40, height: int = 30, **changes: Any) -> Case:
    """Return a case of `count` Gaussians, each a few pixels large, spread over the view and slightly beyond it."""
    focal = 0.9 * width
    depth = rng.uniform(1.5, 6, count)
    offsets = rng.uniform(-0.65, 0.65, (count, 2)) * [width / focal, height / focal]
    camera_points = np.stack([offsets[:, 0] * depth, offsets[:, 1] * depth, depth], axis=1)
    rotation, translation = _orthogonal(POSE[:, :3]), POSE[:, 3]
    parameters = {
        "means": (camera_points - translation) @ rotation,
        "quats": rng.normal(size=(count, 4)) * rng.uniform(0.3, 3, (count, 1)),
        "log_scales": np.log(3 / focal * depth[:, None]) + rng.normal(-0.3, 0.6, (count, 3)),
        "logit_opacity": rng.normal(0.5, 1.5, (count, 1)),
        "sh_base": rng.normal(0, 0.7, (count, 3)),
        "sh_rest": rng.normal(0, 0.15, (count, 45)),
    }
    camera = Camera(width, height, focal, 1.05 * focal, 0.48 * width, 0.53 * height)
    view = View("view", camera, np.concatenate([rotation, translation[:, None]], axis=1), Path("none.png"))
    return replace(Case({k: v.astype(np.float32) for k, v in parameters.items()}, view), **changes)


def add_world_filter(case: Case, rng: np.random.Generator) -> Case:
    """Return the case with a 3D filter of about half the size of each Gaussian."""
    sizes = np.exp(case.parameters["log_scales"].mean(axis=1, keepdims=True))
    variance = (sizes * rng.uniform(0.2, 0.8, sizes.shape)) ** 2
    return replace(case, parameters={**case.parameters, "filter_variance": variance.astype(np.float32)})


def needle_case(rng: np.random.Generator, count: int, aspect: float, **changes: Any) -> Case:
    """Return a case of long Gaussians nearly parallel to the image.

    aspect: ratio of a splat's axes on the screen, after the screen filter.
    """
    case = random_case(rng, count, **changes)
    pose, focal, p = case.view.world_to_camera, case.view.camera.fx, case.parameters
    depth = p["means"] @ pose[2, :3] + pose[2, 3]
    sizes = np.exp(rng.normal(-0.7, 0.1, (count, 3)))  # px
    sizes[:, 0] = aspect * np.sqrt(sizes[:, 1] ** 2 + case.variance)
    rotations = Rotation.from_euler("zyx", rng.uniform([-np.pi, -0.2, -0.2], [np.pi, 0.2, 0.2], (count, 3)))
    p["quats"][:] = (Rotation.from_matrix(pose[:, :3].T) * rotations).as_quat(scalar_first=True)
    p["log_scales"][:] = np.log(sizes / focal * depth[:, None])
    return case


def _orthogonal(matrix: NDArray[Any]) -> NDArray[Any]:
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


def safe_case(
    rng: np.random.Generator,
    count: int,
    width: int,
    height: int,
    margin: float = 2e-6,
    change: Callable[[dict[str, NDArray[Any]]], None] = lambda parameters: None,
    **changes: Any,
) -> Case:
    """Return a random case with no pixel within `margin` of a threshold, so that float32 and float64 blend alike.

    change: function that edits the parameters of each candidate in place.
    """
    for _ in range(200):
        case = random_case(rng, count, width, height, **changes)
        change(case.parameters)
        gaps = ref.margin(case.project(), width, height)
        if min(gaps.alpha, gaps.transmittance, gaps.cap) > margin and gaps.depth > min(margin, 2e-6):
            return case
    raise AssertionError("found no scene with these margins")


Floats = NDArray[Any]


def sums_to_gradients(splats: Splats, sums: Floats) -> tuple[Floats, Floats]:
    """Convert sums over pixels, [N, PIXEL_SUMS], to dL/d(mean2d), [N, 2], and dL/d(conic), [N, 3].

    See cl_kernels/splat.h and pixel_box.h.  The sums of culled splats are 0.
    """
    if splats.pixel_box:
        return sums[:, 1:3], _covariance_gradient(splats, sums[:, 3:6])
    a, b, c = splats.conic.T
    mean2d = -np.stack([a * sums[:, 1] + b * sums[:, 2], b * sums[:, 1] + c * sums[:, 2]], axis=1)
    return mean2d, np.stack([-0.5 * sums[:, 3], -sums[:, 4], -0.5 * sums[:, 5]], axis=1)


def gradients_to_sums(splats: Splats, gradients: ref.SplatGradients) -> Floats:
    """Convert gradients of splats to sums over pixels, [N, PIXEL_SUMS].  This is the inverse of sums_to_gradients."""
    shape, mean2d = gradients.conic, gradients.mean2d
    a, b, c = np.where(splats.visible[:, None], splats.conic, [1.0, 0.0, 1.0]).T
    if splats.pixel_box:
        is_swapped = a > c
        yy, k = np.where(is_swapped, a, c), b / np.where(is_swapped, a, c)
        t2 = (a * c - b * b) / yy
        grad_t2, grad_xy, grad_yy = np.where(is_swapped, shape[:, ::-1].T, shape.T)
        grad_k = yy * (grad_xy + 2 * k * grad_t2)
        grad_s = 2 * (yy * (grad_yy - k * k * grad_t2) + k * grad_k)
        position, second_order = mean2d, np.stack([grad_k, grad_s, 2 * t2 * grad_t2], axis=1)
    else:
        u, v = mean2d.T
        position = np.stack([b * v - c * u, b * u - a * v], axis=1) / (a * c - b * b)[:, None]
        second_order = shape * [-2.0, -1.0, -2.0]
    power = (gradients.opacity * splats.opacity)[:, None]
    return np.concatenate([power, position, second_order, gradients.color], axis=1) * splats.visible[:, None]


def _covariance_gradient(splats: Splats, sums: Floats) -> Floats:
    """Return dL/d(xx, xy, yy), [N, 3], from gradients of k = xy / yy, ln s and ln t, [N, 3].

    s² = yy and t² = xx - xy² / yy.  If xx > yy, x and y are swapped.
    """
    gradient = np.zeros((len(sums), 3))
    for n in np.flatnonzero(splats.visible):
        xx, xy, yy = splats.conic[n]
        is_swapped = xx > yy
        if is_swapped:
            xx, yy = yy, xx
        k, t2 = xy / yy, xx - xy * xy / yy
        grad_k, grad_s, grad_t = sums[n]
        grad_t2 = grad_t / (2 * t2)
        grad_yy = -grad_k * k / yy + grad_s / (2 * yy) + grad_t2 * k * k
        gradient[n] = grad_t2, grad_k / yy - 2 * k * grad_t2, grad_yy
        if is_swapped:
            gradient[n] = gradient[n, ::-1]
    return gradient
