"""What a view says of its place: a pose with a rotation, and the moment of a scene that moves."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import PoseError, quoted
from clsplat.formats.motion import EXPECTED, is_moment

Floats = NDArray[np.floating]
ROTATION_TOLERANCE = 2e-3  # of R Rᵀ: files are read to 1e-3, and an inverse has a little more


def checked_pose(name: str, pose: ArrayLike) -> Floats:
    """Return a world-to-camera pose, [3, 4] float64, of the view `name`.  Raises PoseError without a rotation."""
    found = np.asarray(pose, np.float64)
    if found.shape != (3, 4):
        raise PoseError(f"the pose of {quoted(name)} has shape {found.shape}; expected (3, 4)")
    rotation = found[:, :3]
    if not np.isfinite(found).all():
        raise PoseError(f"the pose of {quoted(name)} has values that are not finite; expected finite numbers")
    with np.errstate(all="ignore"):  # numbers near the end of the range
        turned = rotation @ rotation.T
    if not np.allclose(turned, np.eye(3), atol=ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise PoseError(
            f"the pose of {quoted(name)} has no rotation in its first three columns; "
            "expected axes of length 1 at right angles, not mirrored"
        )
    return found


def checked_time(name: str, time: float | None) -> float | None:
    """Return the time of the view `name`, in [0, 1], or None.  Raises PoseError for anything else."""
    if time is None:
        return None
    if isinstance(time, bool) or not isinstance(time, int | float | np.floating | np.integer):
        raise PoseError(f"the time of {quoted(name)} is {quoted(time)}; expected a number from 0 to 1, or None")
    if not is_moment(time):
        raise PoseError(f"the time of {quoted(name)} is {float(time):g}; {EXPECTED}")
    return float(time)
