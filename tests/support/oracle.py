"""A camera and Gaussians of the float64 reference."""

import numpy as np

from clsplat.conformance import reference as ref

WIDTH, HEIGHT = 40, 30
USUAL = ref.Thresholds()


BACKGROUND = np.array([0.2, 0.5, 0.9])


def general_camera() -> ref.PinholeCamera:
    """Rotated, moved, off-center, fx != fy."""
    rotation = ref.rotation_matrix(np.array([0.9, 0.2, -0.3, 0.15]))
    return ref.PinholeCamera(np.column_stack([rotation, [0.3, -0.2, 0.5]]), 37.0, 43.0, 17.0, 16.5, WIDTH, HEIGHT)


def to_world(camera: ref.PinholeCamera, point: np.ndarray) -> np.ndarray:
    return (point - camera.translation) @ camera.rotation


def random_gaussians(
    rng: np.random.Generator, camera: ref.PinholeCamera, degree: int, count: int = 5
) -> ref.RawGaussians:
    """Gaussians a few pixels wide that overlap in the middle of the image; all 16 harmonics' worth of storage."""
    z = rng.uniform(2, 4, count)
    x, y = rng.uniform(-0.25, 0.25, (2, count)) * z
    sh = rng.normal(0, 0.2, (count, 16, 3))
    sh[:, 0] += 1.5  # far from the clamp at zero
    return ref.RawGaussians(
        means=to_world(camera, np.stack([x, y, z], axis=1)),
        quats=rng.normal(0, 1, (count, 4)) * 1.7,
        log_scales=np.log(rng.uniform(0.1, 0.5, (count, 3))),
        logit_opacity=rng.uniform(-1, 2, count),
        sh=sh[:, : (degree + 2) ** 2],  # some coefficients stay above the active degree
    )


def render_backward(
    gaussians: ref.RawGaussians,
    camera: ref.PinholeCamera,
    background: np.ndarray,
    degree: int,
    splats: ref.Splats,
    grad_image: np.ndarray,
    variance: float = 0.3,
    compensate: float = 0.0,
    thresholds: ref.Thresholds = USUAL,
) -> tuple[dict[str, np.ndarray], ref.SplatGradients]:
    """Return the gradients of the parameters, and those of the splats (for density control)."""
    grad = ref.blend_backward(splats, camera.width, camera.height, background, grad_image, thresholds)
    upstream = grad.mean2d, grad.conic, grad.opacity, grad.color
    return ref.project_backward(gaussians, camera, degree, variance, compensate, splats, *upstream), grad
