"""The checks of a device: named functions that yield figures."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clsplat.conformance.comparison import Figure
from clsplat.opencl.device import Device


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
