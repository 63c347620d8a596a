"""Quaternions (w, x, y, z) of Gaussians that are turned."""

import numpy as np
from numpy.typing import NDArray


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (w, x, y, z) of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the products of a quaternion, [4], and many, [N, 4]."""
    w, x, y, z = left
    a, b, c, d = right.T
    parts = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(parts, axis=1)
