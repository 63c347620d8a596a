"""Adam on the tables of a Gaussians struct, with a learning rate for each."""

import math
from collections.abc import Collection
from typing import Annotated, Any

from pydantic import Field

from clsplat.gaussians.tables import PARAMETERS, DeviceModel, Gaussians, Gradients, sh_coefficients
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.rasterizer import Frame, shape_arguments
from clsplat.settings import Settings

Rate = Annotated[float, Field(ge=0)]


class Decay(Settings):
    """A rate that falls exponentially from `start` to `stop` over a number of steps (Kerbl et al. 2023)."""

    start: Annotated[float, Field(gt=0)]
    stop: Annotated[float, Field(gt=0)]
    over: Annotated[int, Field(gt=0)]  # global steps

    def at(self, step: int) -> float:
        share = min(step / self.over, 1.0)
        return math.exp((1 - share) * math.log(self.start) + share * math.log(self.stop))


class Rates(Settings):
    """Learning rates by parameter.  Those of `means` are multiplied by the scene's extent."""

    means: Decay = Decay(start=1.6e-4, stop=1.6e-6, over=30_000)
    quats: Rate = 1.0e-3
    log_scales: Rate = 5.0e-3
    logit_opacity: Rate = 5.0e-2
    sh_base: Rate = 2.5e-3
    sh_rest: Rate = 1.25e-4

    def at(self, step: int, extent: float) -> dict[str, float]:
        """Rates of a step, by the names of PARAMETERS."""
        fixed = {name: getattr(self, name) for name in PARAMETERS if name != "means"}
        return {"means": self.means.at(step) * extent, **fixed}


class Adam:
    """Moments live beside the parameters; each parameter counts its own updates."""

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
        self.updates = dict.fromkeys(PARAMETERS, 0)
        self._program = gaussians.device.program("adam.cl")
        self._lanes = int(gaussians.device.tuning["LANES"])
        self._vectors = int(gaussians.device.tuning["VECTORS"])
        self._beta1, self._beta2 = constants("adam.h")["BETA1"], constants("adam.h")["BETA2"]
        for name in PARAMETERS:
            for moment in self._moments(name):
                gaussians.add(moment, gaussians.tables[name].components, zero_fresh=True)

    def update(self, model: DeviceModel, frame: Frame, pixel_sums: Array, rates: dict[str, float]) -> Array:
        """Update every parameter from the frame's sums over pixels, [PIXEL_SUMS, S].

        Returns the gradient of the projected means, [2, S] px⁻¹.
        """
        gaussians = self.gaussians
        grad_mean2d = gaussians.device.empty((2, gaussians.capacity))
        arguments: dict[str, Any] = {"sh_base": gaussians["sh_base"]}
        for name in PARAMETERS:
            moment1, moment2 = self._moments(name)
            rate, correction2 = self._factors(name, rates)
            arguments |= {f"{name}_moment1": gaussians[moment1], f"{name}_moment2": gaussians[moment2]}
            arguments |= {f"{name}_rate": rate, f"{name}_correction2": correction2}
        self._program.update_gaussians(
            items=-(-gaussians.count // (self._lanes * self._vectors)),
            **shape_arguments(model, frame.camera),
            **arguments,
            splats=frame.splats,
            pixel_sums=pixel_sums,
            grad_mean2d=grad_mean2d,
        )
        return grad_mean2d

    def step(
        self, model: DeviceModel, gradients: Gradients, rates: dict[str, float], without: Collection[str] = ()
    ) -> None:
        """Update every parameter but those named in `without` from gradients in memory.

        Bands above the active SH degree have neither gradient nor moments, so leaving them out changes nothing.
        """
        gaussians = self.gaussians
        for name in PARAMETERS:
            if name in without:
                continue
            components = gaussians.tables[name].components
            if name == "sh_rest":
                components = 3 * (sh_coefficients(model.degree) - 1)
            moment1, moment2 = self._moments(name)
            rate, correction2 = self._factors(name, rates)
            self._program.adam_step(
                items=(-(-gaussians.count // self._lanes), components),
                values=gaussians[name],
                gradient=gradients[name],
                moment1=gaussians[moment1],
                moment2=gaussians[moment2],
                rate=rate,
                correction2=correction2,
                stride=gaussians.capacity,
                count=gaussians.count,
            )

    def _factors(self, name: str, rates: dict[str, float]) -> tuple[float, float]:
        """Rate and second factor of a parameter's next update, corrected for the moments' start at zero."""
        self.updates[name] += 1
        updates = self.updates[name]
        return rates[name] / (1 - self._beta1**updates), 1 / (1 - self._beta2**updates)

    def forget(self, name: str) -> None:
        """Zero the moments of one parameter."""
        for moment in self._moments(name):
            self.gaussians[moment].fill(0)

    @staticmethod
    def _moments(name: str) -> tuple[str, str]:
        return f"adam/{name}/moment1", f"adam/{name}/moment2"
