"""Penalties on the shapes of Gaussians: each adds its share to the gradient of `log_scales`.

A trace bounds the size of a Gaussian, not its anisotropy; the two are separate terms.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from clsplat.gaussians.tables import INTERVAL2, Gaussians, Gradients
from clsplat.losses.image import LossValue
from clsplat.opencl.device import Array
from clsplat.render.workspace import Workspace
from clsplat.schedule import Weight, at_step
from clsplat.settings import Settings

Positive = Annotated[float, Field(gt=0)]


@dataclass(frozen=True)
class PenaltyInputs:
    """What a penalty works on: Gaussians, the gradients it adds to, and the scene's measures."""

    workspace: Workspace
    gaussians: Gaussians
    gradients: Gradients
    extent: float  # scene units
    step: int

    @property
    def items(self) -> int:
        return -(-self.gaussians.count // int(self.gaussians.device.tuning["LANES"]))

    def sums(self, name: str) -> Array:
        return self.workspace.array(f"{name} sums", self.items)

    def arguments(self) -> dict[str, Any]:
        gaussians = self.gaussians
        return {
            "items": self.items,
            "log_scales": gaussians["log_scales"],
            "grad_log_scales": self.gradients["log_scales"],
            "stride": gaussians.capacity,
            "count": gaussians.count,
        }


class Penalty(Settings):
    """A term of the training loss that looks at Gaussians, not at an image."""

    weight: Weight = 1.0

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the penalty reads beside the parameters."""
        return set()

    @abstractmethod
    def add(self, shapes: PenaltyInputs) -> LossValue:
        """Add weight · d(loss)/d(log_scales) to the gradients."""


class CovarianceTrace(Penalty):
    """Mean over Gaussians of max(tr Σ - τ, 0), lengths by the scene's extent (Micro-splatting, Lee et al. 2025).

    τ is `above`, or, where `pixels` is given, 3 s² for the s that spans so many pixels at the nearest training view,
    as it was at the last edit.
    """

    type: Literal["covariance_trace"] = "covariance_trace"
    above: Annotated[float, Field(ge=0)] = 3.0e-4  # extents²: a standard deviation of 1 % along each axis
    pixels: Positive | None = None  # px

    @property
    def tables(self) -> set[str]:
        return {INTERVAL2} if self.pixels else set()

    def add(self, shapes: PenaltyInputs) -> LossValue:
        gaussians, sums = shapes.gaussians, shapes.sums(f"covariance_trace {self.above} {self.pixels}")
        weight = at_step(self.weight, shapes.step) / max(1, gaussians.count) / shapes.extent**2
        gaussians.device.program("penalty.cl").covariance_trace(
            **shapes.arguments(),
            nearest2=gaussians[INTERVAL2] if self.pixels else gaussians["filter_variance"],  # without pixels: times 0
            sums=sums,
            above=0.0 if self.pixels else self.above * shapes.extent**2,
            pixels2=3.0 * (self.pixels or 0.0) ** 2,
            weight=weight,
        )
        return LossValue("covariance_trace", lambda: weight * float(sums.get().sum(dtype=np.float64)))


class Anisotropy(Penalty):
    """Mean over Gaussians of max(longest / shortest axis - r, 0), with r = `above` (the form of PhysGaussian, Xie et
    al. 2024)."""

    type: Literal["anisotropy"] = "anisotropy"
    above: Annotated[float, Field(ge=1)] = 10.0

    def add(self, shapes: PenaltyInputs) -> LossValue:
        gaussians, sums = shapes.gaussians, shapes.sums(f"anisotropy {self.above}")
        weight = at_step(self.weight, shapes.step) / max(1, gaussians.count)
        gaussians.device.program("penalty.cl").anisotropy(
            **shapes.arguments(), sums=sums, above=self.above, weight=weight
        )
        return LossValue("anisotropy", lambda: weight * float(sums.get().sum(dtype=np.float64)))


SHAPE_LOSSES: dict[str, type[Penalty]] = {"covariance_trace": CovarianceTrace, "anisotropy": Anisotropy}
