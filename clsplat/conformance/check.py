"""The checks of a device: named functions that yield figures."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Device

# How far a kernel's result is from the reference, as a figure with a bound.

PROJECTION = 2e-5  # values of a splat: about 300 operations, determinants that cancel
CONIC = 1e-4  # of a conic, or of a gradient of the projection, by its norm
DEPTH = 1e-6
GRADIENT = 2e-4  # of a gradient through blending, by its norm
SUM = 1e-5  # of a sum of a few hundred positive values
LOSS_GRADIENT = 2e-4  # of the largest value of the gradient


@dataclass(frozen=True)
class Figure:
    """One comparison: what was compared, how far it is off, and how far it may be."""

    kernel: str
    what: str
    value: float
    bound: float
    counts: bool = False  # `value` is a number of wrong values, else a difference

    @property
    def holds(self) -> bool:
        return self.value <= self.bound  # False for NaN

    @property
    def text(self) -> str:
        """The comparison in words."""
        if self.counts:
            wrong = "1 wrong value" if self.value == 1 else f"{self.value:g} wrong values"
            return f"{self.kernel} gives {wrong} in {self.what}" + (f", bound {self.bound:g}" if self.bound else "")
        return f"{self.kernel} differs by {self.value:.1g} in {self.what}, bound {self.bound:.1g}"


def relative_error(value: NDArray[Any], expected: NDArray[Any]) -> float:
    """Norm of the difference by the norm of `expected`."""
    return float(np.linalg.norm(value - expected)) / max(float(np.linalg.norm(expected)), 1e-30)


def by_norm(kernel: str, what: str, value: NDArray[Any], expected: NDArray[Any], bound: float) -> Figure:
    """Compare norms: for gradients, whose small components are sums that cancel."""
    return Figure(kernel, what, relative_error(value, expected), bound)


def by_element(
    kernel: str, what: str, value: NDArray[Any], expected: NDArray[Any], bound: float, floor: float = 0.0
) -> Figure:
    """Compare each value: the largest |value - expected| / (|expected| + floor)."""
    if value.size == 0:
        return Figure(kernel, what, 0.0, bound)
    difference, size = np.abs(np.subtract(value, expected, dtype=np.float64)), np.abs(expected) + floor
    error = np.where(difference == 0, 0, difference / np.where(size > 0, size, 1e-30))
    return Figure(kernel, what, float(error.max()), bound)


def equal(kernel: str, what: str, value: NDArray[Any], expected: NDArray[Any] | float) -> Figure:
    """Count the values that are not exactly as expected."""
    return wrong(kernel, what, value != expected)


def wrong(kernel: str, what: str, mask: NDArray[Any], allowed: float = 0) -> Figure:
    """Count where the mask is set."""
    return Figure(kernel, what, float(np.count_nonzero(mask)), allowed, counts=True)


def image_figures(kernel: str, what: str, value: NDArray[Any], expected: NDArray[Any]) -> Iterator[Figure]:
    """Compare images [C, H, W], with a pixel here and there that falls on the other side of a threshold.

    One splat more or less changes a pixel by up to 1/255 of its color, and colors reach 3.
    """
    difference = np.abs(value - expected).max(axis=0)
    yield Figure(kernel, f"{what}: largest difference", float(difference.max()), 1.5e-2)
    yield Figure(kernel, f"{what}: share of pixels off by 2e-5", float(np.mean(~(difference <= 2e-5))), 2e-3)
    yield Figure(kernel, f"{what}: median difference", float(np.median(difference)), 1e-6)


@dataclass(frozen=True)
class Note:
    """What a check found out beside figures: plain data under a name."""

    name: str
    data: dict[str, Any]


Run = Callable[[Device, np.random.Generator], Iterator[Figure | Note]]


@dataclass(frozen=True)
class Check:
    """Compares some kernels with the reference."""

    name: str
    kernels: tuple[str, ...]
    run: Run

    def figures(self, device: Device) -> Iterator[Figure | Note]:
        """Yield the figures on a device; random numbers depend on the check's name alone."""
        return self.run(device, np.random.default_rng(list(self.name.encode())))


@dataclass
class Checks:
    """A list of checks, to which functions are added by a decorator."""

    listed: list[Check] = field(default_factory=list)

    def add(self, *kernels: str) -> Callable[[Run], Run]:
        """Add a function as a check of these kernels; its name in words is that of the check."""

        def register(run: Run) -> Run:
            self.listed.append(Check(getattr(run, "__name__", "check").replace("_", " "), kernels, run))
            return run

        return register
