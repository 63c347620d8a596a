"""What the kernels' sums over pixels are as gradients of splats (cl_kernels/splat.h, pixel_box.h)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference import Splats

Floats = NDArray[Any]


def gradients_of_sums(splats: Splats, m: Floats) -> tuple[Floats, Floats]:
    """dL/d(mean2d), [N, 2], and dL/d(conic), [N, 3], of sums [N, PIXEL_SUMS]; culled splats have sums of 0."""
    if splats.pixel_box:
        return m[:, 1:3], _covariance_gradient(splats, m[:, 3:6])
    a, b, c = splats.conic.T
    mean2d = -np.stack([a * m[:, 1] + b * m[:, 2], b * m[:, 1] + c * m[:, 2]], axis=1)
    return mean2d, np.stack([-0.5 * m[:, 3], -m[:, 4], -0.5 * m[:, 5]], axis=1)


def _covariance_gradient(splats: Splats, m: Floats) -> Floats:
    """From the derivatives by k = xy / yy, ln s, s² = yy, and ln t, t² = xx - xy² / yy; turned: x for y."""
    found = np.zeros((len(m), 3))
    for n in np.flatnonzero(splats.visible):
        xx, xy, yy = splats.conic[n]
        turned = xx > yy
        if turned:
            xx, yy = yy, xx
        k, t2 = xy / yy, xx - xy * xy / yy
        by_k, by_s, by_t = m[n]
        by_t2 = by_t / (2 * t2)
        by_yy = -by_k * k / yy + by_s / (2 * yy) + by_t2 * k * k
        found[n] = by_t2, by_k / yy - 2 * k * by_t2, by_yy
        if turned:
            found[n] = found[n, ::-1]
    return found
