"""Define protocols and helpers for modules that `gaussians.py` imports and that cannot import its classes."""

import copy
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.formats.splats import PARAMETERS
from clsplat.opencl.device import Array, Device


class DeferredUpdates(Protocol):
    """Deferred Adam updates, as in `DeferredHarmonics`."""

    names: ClassVar[tuple[str, ...]]
    updates: int

    def flush_visible(self, depth_key: Array) -> None:
        """Apply the deferred updates of visible rows."""

    def flush(self) -> None:
        """Apply deferred updates of all rows."""

    def prepare(self, degree: int) -> None:
        """Make room for recording an update of the bands up to `degree`."""

    def record(self, depth_key: Array, factors: tuple[float, float]) -> None:
        """Record an update that has already been applied to visible rows."""


class GaussianTables(Protocol):
    """The part of `Gaussians` that its helpers use."""

    device: Device
    count: int
    capacity: int
    no_slot: Array
    tables: dict[str, Any]

    @property
    def trained(self) -> tuple[str, ...]:
        """The names of the trained tables."""

    @property
    def on_host(self) -> Any:
        """The tables in host memory (`HostTables`), or None if all are on the device."""

    def __getitem__(self, name: str) -> Array: ...

    def get(self, name: str) -> NDArray[Any]:
        """Copy a table to the host."""


# Gradients of a loss with respect to the parameters of Gaussians, in device memory.


class GaussianGradients:
    """Gradients of the loss with respect to each parameter, with the shapes of the parameters."""

    def __init__(self, gaussians: GaussianTables) -> None:
        self.arrays = {name: gaussians.device.zeros(shape) for name, shape in _shapes(gaussians).items()}
        self._withheld_names: tuple[str, ...] = ()
        self.mean2d = gaussians.device.zeros((2, gaussians.capacity))  # px⁻¹, for densification statistics

    def __getitem__(self, name: str) -> Array:
        if name in self._withheld_names:
            raise ConfigError(
                f"a penalty on {name} changes Gaussians outside the view, whose updates are deferred; use penalties on "
                "other parameters, or `update: all` with `rasterizer.harmonics: device`"
            )
        return self.arrays[name]

    def without_deferred(self) -> "GaussianGradients":
        """Return a copy that shares the arrays, but raises ConfigError on access to an array with deferred updates."""
        gradients = copy.copy(self)
        gradients._withheld_names = ("sh_rest",)
        return gradients

    def replace(self, arrays: dict[str, Array]) -> "GaussianGradients":
        """Return a copy with different arrays, given by parameter name."""
        gradients = copy.copy(self)
        gradients.arrays = arrays
        return gradients

    def fits(self, gaussians: GaussianTables) -> bool:
        """Return whether the gradients have the shapes of these Gaussians' parameters."""
        return {name: array.shape for name, array in self.arrays.items()} == _shapes(gaussians)

    def arguments(self) -> dict[str, Any]:
        """Return the gradients that the projection kernels write, by argument name."""
        return {**{f"grad_{name}": self.arrays[name] for name in PARAMETERS}, "grad_mean2d": self.mean2d}


def _shapes(gaussians: GaussianTables) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the trained tables, by name.  For tables in host memory, return the shape of their slots."""
    return {name: gaussians.tables[name].array.shape for name in gaussians.trained}


# Validation of row indices.


def check_rows(rows: NDArray[np.integer], count: int) -> NDArray[np.uint32]:
    """Return row indices, [n], as uint32.  Raises ValueError unless they are distinct integers in [0, count)."""
    if rows.ndim != 1 or not np.issubdtype(rows.dtype, np.integer):
        raise ValueError(
            f"rows: expected integers [n], got {rows.dtype} {list(rows.shape)}; np.flatnonzero gives the rows of a mask"
        )
    invalid_rows = rows[(rows < 0) | (rows >= count)]
    if len(invalid_rows):
        raise ValueError(f"rows: expected integers in [0, {count}), got {invalid_rows[0]}")
    counts = np.bincount(rows.astype(np.int64), minlength=1)
    if counts.max() > 1:
        raise ValueError(f"rows: expected each row once, got row {counts.argmax()} {counts.max()} times")
    return rows.astype(np.uint32)


# The names of the tables of Adam's moments.


def moment_tables(parameter: str) -> tuple[str, str]:
    """Return the names of the tables of a parameter's two Adam moments."""
    return f"adam/{parameter}/moment1", f"adam/{parameter}/moment2"


HARMONICS = ("sh_rest", *moment_tables("sh_rest"))  # bands above 0: most of the memory of a Gaussian
