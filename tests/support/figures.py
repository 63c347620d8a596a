"""What kernel tests assert of the figures that checks of a device yield."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Figure, relative_error
from clsplat.opencl.device import Device


def hold(figures: Iterable[Figure]) -> None:
    """Fail with a sentence for every figure beyond its bound, and where there is none."""
    found = list(figures)
    assert found
    assert not [figure.text for figure in found if not figure.holds]


def same_of_schedules(device: Device, found: NDArray[np.float32], expected: NDArray[np.float32]) -> None:
    """Fail where what one schedule computes is not that of the other: its bits on a CPU; a GPU's compiler may join
    multiplications and additions in one schedule that it leaves apart in the other.
    """
    if device.info.kind == "CPU":
        np.testing.assert_array_equal(found, expected)
    else:
        assert relative_error(found, expected) < 1e-5
