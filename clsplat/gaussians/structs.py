"""What the parts of a Gaussians struct know of each other."""

import copy
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.formats.splats import PARAMETERS
from clsplat.opencl.device import Array, Device


class DeferredUpdates(Protocol):
    """Updates that rows wait for, as `Deferred` does them."""

    names: ClassVar[tuple[str, ...]]
    updates: int

    def catch_up(self, depth_key: Array) -> None:
        """Do what waits for the rows that a view sees."""

    def flush(self) -> None:
        """Do what waits for all rows."""

    def prepare(self, degree: int) -> None:
        """Make room for an update of the bands up to a degree."""

    def record(self, depth_key: Array, factors: tuple[float, float]) -> None:
        """Note an update that the rows that a view sees have had."""


class Struct(Protocol):
    """The part of `Gaussians` that its own parts use."""

    device: Device
    count: int
    capacity: int
    no_slot: Array
    tables: dict[str, Any]

    @property
    def trained(self) -> tuple[str, ...]:
        """The names of what training changes."""

    @property
    def on_host(self) -> Any:
        """The tables that lie on the host, `OnHost`, or None."""

    def __getitem__(self, name: str) -> Array: ...

    def get(self, name: str) -> NDArray[Any]:
        """Copy a table to the host."""


# Derivatives of a loss by the parameters of Gaussians, in device memory.


class GaussianGradients:
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

    def without_deferred(self) -> "GaussianGradients":
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


# Rows of tables, as a caller gives them and as a kernel takes them.


def check_rows(rows: NDArray[np.integer], count: int) -> NDArray[np.uint32]:
    """Return rows, [n], as a kernel takes them; raise ValueError unless they are different integers in [0, count)."""
    if rows.ndim != 1 or not np.issubdtype(rows.dtype, np.integer):
        raise ValueError(
            f"rows: expected integers [n], got {rows.dtype} {list(rows.shape)}; np.flatnonzero gives the rows of a mask"
        )
    outside = rows[(rows < 0) | (rows >= count)]
    if len(outside):
        raise ValueError(f"rows: expected integers in [0, {count}), got {outside[0]}")
    times = np.bincount(rows.astype(np.int64), minlength=1)
    if times.max() > 1:
        raise ValueError(f"rows: expected each row once, got row {times.argmax()} {times.max()} times")
    return rows.astype(np.uint32)


# The names of the tables that hold Adam's moments.


def moment_tables(parameter: str) -> tuple[str, str]:
    """Return the names of the tables that hold Adam's two moments of a parameter."""
    return f"adam/{parameter}/moment1", f"adam/{parameter}/moment2"


HARMONICS = ("sh_rest", *moment_tables("sh_rest"))  # above band 0: most of a Gaussian
