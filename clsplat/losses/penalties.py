"""Define penalties on the sizes, shapes, and opacities of Gaussians."""

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from clsplat.core.schedule import at_step
from clsplat.gaussians.gaussians import INTERVAL2
from clsplat.losses.base import LossValue, Penalty, PenaltyInputs
from clsplat.render.filters import AT_REST


class CovarianceTrace(Penalty):
    """Mean over Gaussians of max(tr Σ - τ, 0), in units of the squared scene extent (Micro-splatting, Lee et al. 2025).

    τ is `above`, or with `pixels`, 3 s², where s is the length of `pixels` pixels in the training view that was nearest
    at the last edit.
    """

    type: Literal["covariance_trace"] = "covariance_trace"
    above: Annotated[float, Field(ge=0)] = 3.0e-4
    """τ, extents²; the default is a standard deviation of 1% of the extent along each axis."""
    pixels: Annotated[float, Field(gt=0)] | None = None
    """Bound of the standard deviations, in pixels of the nearest training view; replaces `above`."""

    @property
    def tables(self) -> set[str]:
        return {INTERVAL2} if self.pixels else set()

    def active_conflicts(self) -> Mapping[str, str]:
        return AT_REST if self.pixels else {}

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums(f"covariance_trace {self.above} {self.pixels}")
        weight = at_step(self.weight, inputs.step) / max(1, gaussians.count) / inputs.extent**2
        gaussians.device.program("penalty.cl").covariance_trace(
            **inputs.arguments("log_scales"),
            nearest2=gaussians[INTERVAL2] if self.pixels else gaussians["filter_variance"],  # any: times 0
            sums=sums,
            above=0.0 if self.pixels else self.above * inputs.extent**2,
            pixels2=3.0 * (self.pixels or 0.0) ** 2,
            weight=weight,
        )
        return LossValue("covariance_trace", lambda: weight * float(sums.get().sum(dtype=np.float64)))


class Anisotropy(Penalty):
    """Mean over Gaussians of max(longest / shortest axis - r, 0), with r = `above` (the form of PhysGaussian, Xie et
    al. 2024)."""

    type: Literal["anisotropy"] = "anisotropy"
    above: Annotated[float, Field(ge=1)] = 10.0
    """r: the largest ratio without a penalty."""

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums(f"anisotropy {self.above}")
        weight = at_step(self.weight, inputs.step) / max(1, gaussians.count)
        gaussians.device.program("penalty.cl").anisotropy(
            **inputs.arguments("log_scales"), sums=sums, above=self.above, weight=weight
        )
        return LossValue("anisotropy", lambda: weight * float(sums.get().sum(dtype=np.float64)))


class MeanScale(Penalty):
    """Mean of all scales, in units of the scene extent (3DGS-MCMC, Kheradmand et al. 2024, uses scene units)."""

    type: Literal["mean_scale"] = "mean_scale"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums("mean_scale")
        weight = at_step(self.weight, inputs.step) / max(1, 3 * gaussians.count) / inputs.extent
        gaussians.device.program("penalty.cl").mean_scale(**inputs.arguments("log_scales"), sums=sums, weight=weight)
        return LossValue("mean_scale", lambda: weight * float(sums.get().sum(dtype=np.float64)))


class MinScale(Penalty):
    """Mean of the smallest scale of each Gaussian, in units of the scene extent: flattens Gaussians, for surfaces
    (NeuSG, Chen et al. 2023; PGSR, Chen et al. 2024, uses a weight of 100 and scene units)."""

    type: Literal["min_scale"] = "min_scale"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums("min_scale")
        weight = at_step(self.weight, inputs.step) / max(1, gaussians.count) / inputs.extent
        gaussians.device.program("penalty.cl").min_scale(**inputs.arguments("log_scales"), sums=sums, weight=weight)
        return LossValue("min_scale", lambda: weight * float(sums.get().sum(dtype=np.float64)))


class MeanOpacity(Penalty):
    """Mean of all opacities (3DGS-MCMC, Kheradmand et al. 2024)."""

    type: Literal["mean_opacity"] = "mean_opacity"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        gaussians, sums = inputs.gaussians, inputs.sums("mean_opacity")
        weight = at_step(self.weight, inputs.step) / max(1, gaussians.count)
        arguments = inputs.arguments("logit_opacity")
        del arguments["stride"]  # not needed, since the table has one component
        gaussians.device.program("penalty.cl").mean_opacity(**arguments, sums=sums, weight=weight)
        return LossValue("mean_opacity", lambda: weight * float(sums.get().sum(dtype=np.float64)))
