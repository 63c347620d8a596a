"""Convert and multiply quaternions (w, x, y, z) on the host."""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def rotation_matrix(w: ArrayLike, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Floats:
    """Return the rotation matrices [..., 3, 3] of unit quaternions whose components have the shape [...]."""
    w, x, y, z = (np.asarray(component, np.float64) for component in (w, x, y, z))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def unit_quaternions(rotations: NDArray[np.floating]) -> Floats:
    """Return the unit quaternions [..., 4] of rotation matrices [..., 3, 3]."""
    quaternions: Floats = np.roll(scipy.spatial.transform.Rotation.from_matrix(rotations).as_quat(), 1, axis=-1)
    return quaternions


def multiply(left: Floats, right: Floats) -> Floats:
    """Multiply quaternions, [N, 4]; one of the two may be [4]."""
    (w, x, y, z), (a, b, c, d) = left.T, right.T
    components = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(components, axis=1)
