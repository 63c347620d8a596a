"""Let Gaussians compete for opacity until a given number remains (natural selection, GNS, Deng et al. 2025)."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from clsplat.core.schedule import at_step
from clsplat.losses.base import LossValue, Penalty, PenaltyInputs


class OpacityPressure(Penalty):
    """Mean of max(l - `floor`, 0) over the opacity logits l; the penalty lowers all of them equally.

    Only Gaussians that the image loss needs stay opaque; `prune_faint` removes the others.
    """

    type: Literal["opacity_pressure"] = "opacity_pressure"
    floor: float = -20.0
    """Logit below which an opacity is not lowered."""
    gaussians: Annotated[int, Field(ge=0)] = 0
    """Number of Gaussians at or below which the penalty is off."""

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums("opacity_pressure")
        is_active = gaussians.count > self.gaussians
        weight = at_step(self.weight, inputs.step) / max(1, gaussians.count) if is_active else 0.0
        arguments = inputs.arguments("logit_opacity")
        del arguments["stride"]  # not needed, since the table has one component
        gaussians.device.program("penalty.cl").opacity_pressure(**arguments, sums=sums, low=self.floor, weight=weight)
        return LossValue("opacity_pressure", lambda: weight * float(sums.get().sum(dtype=np.float64)))
