"""Initialize the motion of Gaussians: static and long-lived, unless points were visible only part of the time."""

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, shell_quote
from clsplat.formats.splats import MOTION, Parameters, motion_fields
from clsplat.gaussians.motion import static_motion
from clsplat.render.filters import Motion
from clsplat.scene.scene import Scene

RANDOM_STREAM = 4  # stream of random numbers, different from the stream of the points
NEIGHBORS = 16  # number of nearest points whose timestamps decide whether a point is static (our choice)
STATIC_SPREAD = 0.18  # spread of these timestamps above which a point is static (our choice)


def require_times(scene: Scene, motion: Motion | None) -> None:
    """Raise DataError if the model has motion, and views of the scene have no timestamps."""
    if motion is None:
        return
    if untimed := [view.name for view in scene.views if view.time is None]:
        problem = (
            "its views have no timestamps" if len(untimed) == len(scene.views) else f"{untimed[0]} has no timestamp"
        )
        raise DataError(
            f"{scene.path}: {problem}, which `model.time` needs; add a timestamp for each photo "
            "(docs/moving.md), or use a pipeline for static scenes, such as splat_7k"
        )


def add_motion(
    parameters: Parameters,
    motion: Motion | None,
    point_times: NDArray[np.floating] | None,
    durations: tuple[float, float],
    seed: int,
) -> Parameters:
    """Return the tables of Gaussians with an initial motion, or unchanged if `motion` is None.

    point_times: [N], timestamps at which the points were observed; None for random ones.  durations: the duration of
    static Gaussians, and the shortest duration of moving Gaussians, as fractions of the scene's duration.
    """
    if motion is None:
        return parameters
    count = len(parameters["means"])
    table, fields = static_motion(count, motion.width), motion_fields(motion.width)
    times = np.random.default_rng([seed, count, RANDOM_STREAM]).uniform(0, 1, count)
    duration = np.full(count, np.log(durations[0]))
    if point_times is not None:
        times = point_times.astype(np.float64)
        spread, velocities = estimate_motion(parameters["means"].astype(np.float64), times)
        is_static = spread > STATIC_SPREAD
        table[:, fields["velocity"]] = np.where(is_static, 0, velocities.T).T
        duration = np.log(np.where(is_static, durations[0], np.maximum(spread, durations[1])))
    table[:, fields["time_center"]] = times[:, None]
    table[:, fields["log_duration"]] = duration[:, None]
    return {**parameters, MOTION: table}


def estimate_motion(
    positions: NDArray[np.float64], times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the spread and the velocity of the neighbors of each point.

    The spread is the standard deviation of the neighbors' timestamps, [N]: 0.29 for static points that are visible at
    all times, less for moving points.  The velocity is the least-squares slope of the neighbors' positions over their
    timestamps, [N, 3], in scene units per duration of the scene.
    """
    nearest = scipy.spatial.cKDTree(positions).query(positions, k=min(NEIGHBORS, len(positions)), workers=-1)[1]
    nearest = nearest.reshape(len(positions), -1)
    offsets = times[nearest] - times[nearest].mean(axis=1, keepdims=True)
    squares = (offsets**2).sum(axis=1)
    products = (offsets[:, :, None] * positions[nearest]).sum(axis=1)
    velocities = np.divide(products, squares[:, None], out=np.zeros_like(products), where=squares[:, None] > 0)
    return np.sqrt(squares / nearest.shape[1]), velocities


def with_motion(parameters: Parameters, motion: Motion | None, file: str) -> Parameters:
    """Return the tables of a model file with the motion of the settings.  A static model gets a motion of zero.

    Raises ConfigError if the motion of the file differs from the settings.
    """
    columns, expected = (parameters[MOTION].shape[1] if MOTION in parameters else 0), motion.width if motion else 0
    if columns == expected:
        return parameters
    if columns:
        setting = "another degree or rotation" if expected else "no `model.time`"
        raise ConfigError(
            f"{file}: its Gaussians move, and the pipeline has {setting}; set `model.time` as in the file, "
            f"or start from one frame: `clsplat convert {shell_quote(file)} FRAME.ply --time T`"
        )
    return {**parameters, MOTION: static_motion(len(parameters["means"]), expected)}
