"""The world filter: how finely cameras sample each Gaussian (Yu et al. 2024, 5.1)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.kinds import Camera


def sampling_interval(
    means: NDArray[Any], cameras: list[Camera], focal: list[float], near: float = 0.2, margin: float = 0.15
) -> NDArray[Any]:
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


def filtered(
    log_scales: NDArray[Any], logit: NDArray[Any], variance: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Standard deviations and opacities as they are drawn: [N,3], [N] -> [N,3], [N]."""
    scale = np.exp(log_scales)
    drawn = np.sqrt(scale**2 + variance[:, None])
    return drawn, np.prod(scale / drawn, axis=1) / (1 + np.exp(-logit))
