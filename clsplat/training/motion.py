"""Update the motion of Gaussians by Adam, with a rate for each field and a bound on durations."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from clsplat.core.schedule import Bounded, Decay, Schedule, at_step, divide
from clsplat.core.settings import Settings
from clsplat.formats.splats import MOTION, motion_fields
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import GaussianGradients, moment_tables
from clsplat.opencl.device import Array, constants

MAX_LOG_DURATION = 15.0  # longer durations look the same
NO_BOUND = 3.0e38
RATES_IN_EXTENTS = ("velocity", "acceleration", "jerk")
Rate = Annotated[Schedule, AfterValidator(Bounded(0, maximum=100.0))]


class MotionRates(Settings):
    """Learning rates of the motion, which may be scheduled, and the bound on durations.

    Time is normalized to 0 at the first and 1 at the last timestamp of the scene.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"min_duration"})

    velocity: Rate = Decay(initial=1.0e-3, final=1.0e-5, over=30_000)
    """Learning rate of velocities, in units of the scene's extent; it decays, as in FreeTimeGS."""
    time_center: Rate = 1.0e-3
    """Learning rate of time centers, at which opacities are largest."""
    log_duration: Rate = 1.0e-2
    """Learning rate of the logarithms of durations."""
    acceleration: Rate = Decay(initial=1.0e-3, final=1.0e-5, over=30_000)
    """Learning rate of accelerations, in units of the scene's extent."""
    jerk: Rate = Decay(initial=1.0e-3, final=1.0e-5, over=30_000)
    """Learning rate of the cubic coefficients, in units of the scene's extent."""
    turn: Rate = 1.0e-3
    """Learning rate of the time derivatives of quaternions."""
    min_duration: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """Lower bound of durations; a Gaussian that is much shorter than a frame is invisible between two frames."""

    def scale(self, factor: float) -> "MotionRates":
        """Return the rates, each multiplied by a factor."""
        return self.model_copy(update={name: divide(getattr(self, name), 1 / factor) for name in self._rates})

    @property
    def _rates(self) -> list[str]:
        return [name for name in type(self).model_fields if name != "min_duration"]

    def at(self, step: int, extent: float) -> dict[str, float]:
        """Return the rates at a global step, by field, and `min_duration`.  extent: extent of the scene."""
        rates = {name: at_step(getattr(self, name), step) for name in self._rates}
        return {**rates, **{name: rates[name] * extent for name in RATES_IN_EXTENTS}, "min_duration": self.min_duration}


def update_motion(
    gaussians: Gaussians,
    gradients: GaussianGradients,
    depth_key: Array,
    rates: Mapping[str, float],
    updates: int,
    every: int,
) -> None:
    """Update the motion of all or only the visible Gaussians with Adam.

    depth_key: depth keys of the view, [S]; rates: from `MotionRates.at`; updates: update count, including this one;
    every: all bits set to update all rows, 0 to update only visible rows.
    """
    table, (moment1, moment2) = gaussians.tables[MOTION], moment_tables(MOTION)
    beta1, beta2 = constants("adam.h")["BETA1"], constants("adam.h")["BETA2"]
    min_duration = math.log(rates["min_duration"]) if rates["min_duration"] else -MAX_LOG_DURATION
    bounds = {"log_duration": (min_duration, MAX_LOG_DURATION)}
    arguments: dict[str, Any] = {
        "motion": table.array,
        "gradient": gradients[MOTION],
        "moment1": gaussians[moment1],
        "moment2": gaussians[moment2],
        "depth_key": depth_key,
        "correction2": 1 / (1 - beta2**updates),
        "every": every,
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }
    for name, columns in motion_fields(table.components).items():
        lowest, highest = bounds.get(name, (-NO_BOUND, NO_BOUND))
        gaussians.device.program("motion.cl").motion_step(
            items=(-(-gaussians.count // int(gaussians.device.tuning["LANES"])), columns.stop - columns.start),
            **arguments,
            rate=rates[name] / (1 - beta1**updates),
            lowest=lowest,
            highest=highest,
            first=columns.start,
        )
