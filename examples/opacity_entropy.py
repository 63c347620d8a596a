"""Penalize opacities that are neither 0 nor 1: `losses: [..., {type: opacity_entropy, weight: 0.01}]`."""

from pathlib import Path
from typing import Literal

import numpy as np

from clsplat.plugin import LossValue, Penalty, PenaltyInputs, at_step


class OpacityEntropy(Penalty):
    """Mean binary entropy of the opacities."""

    type: Literal["opacity_entropy"] = "opacity_entropy"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        weight, sums = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count), inputs.sums(self.type)
        program = inputs.gaussians.device.program(Path(__file__).with_suffix(".cl"))
        program.opacity_entropy(**inputs.arguments("logit_opacity"), sums=sums, weight=weight)
        return LossValue(self.type, lambda: weight * float(sums.get().sum(dtype=np.float64)))
