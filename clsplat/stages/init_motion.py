"""The motion of the first Gaussians: none, for a long time, but where points were seen in some moments only."""

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, shell_quote
from clsplat.formats.splats import MOTION, Parameters, fields_of
from clsplat.gaussians.motion import still
from clsplat.render.filters import Motion
from clsplat.scene.scene import Scene

STREAM = 4  # of the random numbers, beside those of the points
NEIGHBORS = 16  # whose times say whether a point stands still (ours)
STANDS = 0.18  # spread of those times above which it does (ours); below it moves as they do


def require_times(scene: Scene, motion: Motion | None) -> None:
    """Raise DataError for a scene whose views have no times, where Gaussians are to move."""
    if motion is None:
        return
    if missing := [view.name for view in scene.views if view.time is None]:
        which = "its views have no times" if len(missing) == len(scene.views) else f"{missing[0]} has no time"
        raise DataError(
            f"{scene.path}: {which}, and `model.time` lets Gaussians move; expected a time for each photograph "
            "(docs/moving.md), or a pipeline of a scene that stands still, such as splat_7k"
        )


def moving(
    parameters: Parameters,
    motion: Motion | None,
    seen: NDArray[np.floating] | None,
    durations: tuple[float, float],
    seed: int,
) -> Parameters:
    """Return the tables of Gaussians with a first motion, where settings let them move, else as they are.

    seen: [N] times in which their points were seen; without them times are drawn.  durations: of what stands still, and
    the shortest of what moves; both by the scene's duration.
    """
    if motion is None:
        return parameters
    count = len(parameters["means"])
    table, fields = still(count, motion.width), fields_of(motion.width)
    times = np.random.default_rng([seed, count, STREAM]).uniform(0, 1, count)
    duration = np.full(count, np.log(durations[0]))
    if seen is not None:
        times = seen.astype(np.float64)
        spread, velocities = drift(parameters["means"].astype(np.float64), times)
        table[:, fields["velocity"]] = np.where(spread > STANDS, 0, velocities.T).T
        duration = np.log(np.where(spread > STANDS, durations[0], np.maximum(spread, durations[1])))
    table[:, fields["time_center"]] = times[:, None]
    table[:, fields["log_duration"]] = duration[:, None]
    return {**parameters, MOTION: table}


def drift(
    positions: NDArray[np.float64], times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far apart in time the points near each one were seen, the standard deviation, [N], and how their
    places follow their times, the slope in least squares, [N, 3] scene units by the scene's duration.

    What stands still is seen at the same place at all moments: 0.29, if they are evenly spread.  What moves is there
    for a while.
    """
    nearest = scipy.spatial.cKDTree(positions).query(positions, k=min(NEIGHBORS, len(positions)), workers=-1)[1]
    nearest = nearest.reshape(len(positions), -1)
    apart = times[nearest] - times[nearest].mean(axis=1, keepdims=True)
    square = (apart**2).sum(axis=1)
    along = (apart[:, :, None] * positions[nearest]).sum(axis=1)
    velocities = np.divide(along, square[:, None], out=np.zeros_like(along), where=square[:, None] > 0)
    return np.sqrt(square / nearest.shape[1]), velocities


def with_motion(parameters: Parameters, motion: Motion | None, file: str) -> Parameters:
    """Return the tables of a model file for settings of `model.time`: one that stands still gets a motion of none.

    Raises ConfigError for another motion than that of the settings.
    """
    own, expected = (parameters[MOTION].shape[1] if MOTION in parameters else 0), motion.width if motion else 0
    if own == expected:
        return parameters
    if own:
        have = "another degree or rotation" if expected else "no `model.time`"
        raise ConfigError(
            f"{file}: holds Gaussians that move, and the pipeline has {have}; give those of the file, "
            f"or start from one moment of it: `clsplat convert {shell_quote(file)} FRAME.ply --time T`"
        )
    return {**parameters, MOTION: still(len(parameters["means"]), expected)}
