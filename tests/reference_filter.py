"""The oracle of the world filter: how finely cameras sample each Gaussian, in float64 NumPy (Yu et al. 2024, 5.1)."""

import numpy as np

from tests.reference import Camera


def sampling_interval(
    means: np.ndarray, cameras: list[Camera], focal: list[float], near: float = 0.2, margin: float = 0.15
) -> np.ndarray:
    """Smallest depth / focal length over the cameras that see each mean; the largest of them where none does: [N]."""
    intervals = np.full(len(means), np.inf)
    for n, mean in enumerate(means):
        for camera, f in zip(cameras, focal, strict=True):
            x, y, z = camera.rotation @ mean + camera.translation
            if not z > near:
                continue
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if (
                -margin * camera.width <= u <= (1 + margin) * camera.width
                and -margin * camera.height <= v <= (1 + margin) * camera.height
            ):
                intervals[n] = min(intervals[n], z / f)
    seen = np.isfinite(intervals)
    intervals[~seen] = intervals[seen].max(initial=0)
    return intervals


def filtered(log_scales: np.ndarray, logit: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and opacities as they are drawn: [N,3], [N] -> [N,3], [N]."""
    scale = np.exp(log_scales)
    drawn = np.sqrt(scale**2 + variance[:, None])
    return drawn, np.prod(scale / drawn, axis=1) / (1 + np.exp(-logit))
