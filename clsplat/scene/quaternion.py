"""Quaternions (w, x, y, z), rotation matrices and poses."""

import math
from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import quoted
from clsplat.scene.points import MAX_VALUE

Floats = NDArray[np.float64]


def rotation_matrix(w: ArrayLike, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Floats:
    """Return the rotation matrices [..., 3, 3] of unit quaternions whose parts have the shape [...]."""
    w, x, y, z = (np.asarray(part, np.float64) for part in (w, x, y, z))
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


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> Floats:
    """Return the pose [3, 4] of a quaternion of any length but zero and a translation in scene units.

    Raises ValueError when numbers are missing or not finite, or the quaternion is zero.
    """
    length = math.hypot(*quaternion)
    sizes = len(quaternion), len(translation)
    if sizes != (4, 3) or not 0 < length < math.inf or not all(abs(part) < MAX_VALUE for part in translation):
        raise ValueError(
            f"quaternion {quoted(tuple(quaternion))}, translation {quoted(tuple(translation))}; "
            "expected finite numbers and a rotation"
        )
    return np.column_stack([rotation_matrix(*(part / length for part in quaternion)), translation])
