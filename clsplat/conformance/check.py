"""Define device checks: named functions that compare kernels with the reference and yield deviations."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Device


class Tol:
    """Tolerances of float32 results: bounds on relative errors."""

    PROJECTION = 2e-5  # values of a splat: about 300 operations, and determinants with cancellation
    CONIC = 1e-4  # a conic, or a gradient of the projection, relative to its norm
    DEPTH = 1e-6  # the depth of a splat
    GRADIENT = 2e-4  # a gradient through blending, relative to its norm
    SUM = 1e-5  # a sum of a few hundred positive values
    LOSS_GRADIENT = 2e-4  # relative to the largest value of the gradient


@dataclass(frozen=True)
class Deviation:
    """The deviation in one comparison with the reference, and the bound on it."""

    kernel: str
    label: str  # the values that were compared
    value: float
    bound: float
    counts: bool = False  # whether `value` is a number of wrong values instead of a difference

    @property
    def passes(self) -> bool:
        return self.value <= self.bound  # False for NaN

    @property
    def text(self) -> str:
        """The deviation as a sentence."""
        if self.counts:
            count = "1 wrong value" if self.value == 1 else f"{self.value:g} wrong values"
            return f"{self.kernel} gives {count} in {self.label}" + (f" (at most {self.bound:g})" if self.bound else "")
        return f"{self.kernel} differs by {self.value:.1g} in {self.label} (at most {self.bound:.1g})"


def relative_error(value: NDArray[Any], expected: NDArray[Any]) -> float:
    """Return the norm of the difference divided by the norm of `expected`."""
    return float(np.linalg.norm(value - expected)) / max(float(np.linalg.norm(expected)), 1e-30)


def compare(kernel: str, label: str, value: NDArray[Any], expected: NDArray[Any], bound: float) -> Deviation:
    """Compare arrays by norm.  Use this for gradients, whose small components suffer from cancellation."""
    return Deviation(kernel, label, relative_error(value, expected), bound)


def compare_max(
    kernel: str, label: str, value: NDArray[Any], expected: NDArray[Any], bound: float, floor: float = 0.0
) -> Deviation:
    """Compare arrays elementwise.  The deviation is the largest |value - expected| / (|expected| + floor)."""
    if value.size == 0:
        return Deviation(kernel, label, 0.0, bound)
    difference, scale = np.abs(np.subtract(value, expected, dtype=np.float64)), np.abs(expected) + floor
    error = np.where(difference == 0, 0, difference / np.where(scale > 0, scale, 1e-30))
    return Deviation(kernel, label, float(error.max()), bound)


def match(kernel: str, label: str, value: NDArray[Any], expected: NDArray[Any] | float) -> Deviation:
    """Count the values that differ from `expected`; the check passes if there are none."""
    return count_true(kernel, label, value != expected)


def count_true(kernel: str, label: str, mask: NDArray[Any], limit: float = 0) -> Deviation:
    """Count the True values of a mask; the check passes if there are at most `limit`."""
    return Deviation(kernel, label, float(np.count_nonzero(mask)), limit, counts=True)


def check_image(kernel: str, label: str, value: NDArray[Any], expected: NDArray[Any]) -> Iterator[Deviation]:
    """Compare images, [C, H, W].  A few pixels, where a splat crosses a threshold, may differ more.

    Such a splat changes a pixel by at most 1/255 of the splat's color, and colors are at most 3.
    """
    difference = np.abs(value - expected).max(axis=0)
    yield Deviation(kernel, f"{label}: largest difference", float(difference.max()), 1.5e-2)
    yield Deviation(
        kernel,
        f"{label}: fraction of pixels that differ by more than 2e-5",
        float(np.mean(~(difference <= 2e-5))),
        2e-3,
    )
    yield Deviation(kernel, f"{label}: median difference", float(np.median(difference)), 1e-6)


@dataclass(frozen=True)
class Note:
    """Named data that a check reports in addition to its deviations."""

    name: str
    data: dict[str, Any]


Results = Iterator[Deviation | Note]
CheckFunction = Callable[[Device, np.random.Generator], Results]


@dataclass(frozen=True)
class Check:
    """A comparison of some kernels with the reference."""

    name: str
    kernels: tuple[str, ...]
    run: CheckFunction

    def deviations(self, device: Device) -> Results:
        """Run the check on a device and yield its results.  The random numbers depend only on the check's name."""
        return self.run(device, np.random.default_rng(list(self.name.encode())))


@dataclass
class Checks:
    """A list of checks; `add` is the decorator that adds a function to it."""

    checks: list[Check] = field(default_factory=list)

    def add(self, *kernels: str) -> Callable[[CheckFunction], CheckFunction]:
        """Return a decorator that adds a function as a check of `kernels`.

        The name of the check is the name of the function, with spaces instead of underscores.
        """

        def register(run: CheckFunction) -> CheckFunction:
            self.checks.append(Check(getattr(run, "__name__", "check").replace("_", " "), kernels, run))
            return run

        return register
