"""Penalties on the motion of Gaussians, which keep what stands still where it is, and what is there, there."""

import math
from typing import Annotated, Literal

from pydantic import Field

from clsplat.errors import ConfigError
from clsplat.formats.motion import MOTION
from clsplat.losses.base import LossValue, Penalty, PenaltyInputs
from clsplat.schedule import at_step


class Travel(Penalty):
    """Mean over Gaussians of min(s, 1) |v|, in extents: the way of each while it is there, s its duration (ours).

    Meant for velocities of which the photographs say little.  On the synthetic scene it lost 0.3 to 0.5 dB, beside
    `brevity` (docs/moving.md), and no recipe has it.
    """

    type: Literal["travel"] = "travel"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_motion(self.type, inputs)
        sums = inputs.sums("travel")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count) / inputs.extent
        inputs.gaussians.device.program("motion_penalty.cl").travel(
            **inputs.arguments(MOTION), sums=sums, weight=weight
        )
        return LossValue("travel", lambda: weight * float(sums.get().sum(dtype="float64")))


class Brevity(Penalty):
    """Mean over Gaussians of max(log(s₀ / s), 0), s₀ = `below`: against durations that show one moment alone (ours).

    No recipe has it: see `travel`.
    """

    type: Literal["brevity"] = "brevity"
    below: Annotated[float, Field(gt=0)] = 1.0
    """s₀, the duration from which on there is no penalty, by the scene's duration."""

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_motion(self.type, inputs)
        sums = inputs.sums(f"brevity {self.below}")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count)
        inputs.gaussians.device.program("motion_penalty.cl").brevity(
            **inputs.arguments(MOTION), sums=sums, log_below=math.log(self.below), weight=weight
        )
        return LossValue("brevity", lambda: weight * float(sums.get().sum(dtype="float64")))


def require_motion(name: str, inputs: PenaltyInputs) -> None:
    """Raise ConfigError where a penalty on the motion has none."""
    if not inputs.gaussians.moves:
        raise ConfigError(f"the loss '{name}': expected Gaussians that move; give `model.time`, or leave the loss out")
