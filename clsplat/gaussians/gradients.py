"""Derivatives of a loss by the parameters of Gaussians, in device memory."""

import copy
from typing import Any

from clsplat.errors import ConfigError
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.struct import Struct
from clsplat.opencl.device import Array


class Gradients:
    """Derivatives of the loss by each parameter, with the shapes of the parameters."""

    def __init__(self, gaussians: Struct) -> None:
        self.arrays = {name: gaussians.device.zeros(shape) for name, shape in _shapes(gaussians).items()}
        self._withheld: tuple[str, ...] = ()
        self.mean2d = gaussians.device.zeros((2, gaussians.capacity))  # px⁻¹, for density statistics

    def __getitem__(self, name: str) -> Array:
        if name in self._withheld:
            raise ConfigError(
                f"a penalty on {name} changes Gaussians that the view does not see, whose updates wait; expected "
                "penalties on other parameters, or `update: all` with `rasterizer.harmonics: device`"
            )
        return self.arrays[name]

    def without_deferred(self) -> "Gradients":
        """Return the same arrays without those of updates that wait for a view: [name] raises ConfigError for them."""
        other = copy.copy(self)
        other._withheld = ("sh_rest",)
        return other

    def fits(self, gaussians: Struct) -> bool:
        """Return whether the shapes are those of the parameters of these Gaussians."""
        return {name: array.shape for name, array in self.arrays.items()} == _shapes(gaussians)

    def arguments(self) -> dict[str, Any]:
        """Return those of the projection by the names of its kernels' arguments."""
        return {**{f"grad_{name}": self.arrays[name] for name in PARAMETERS}, "grad_mean2d": self.mean2d}


def _shapes(gaussians: Struct) -> dict[str, tuple[int, ...]]:
    """By the names of what is trained; what lies on the host has the shape of its slots."""
    return {name: gaussians.tables[name].array.shape for name in gaussians.trained}
