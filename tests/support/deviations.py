"""Assert that the deviations that checks of a device yield are within bounds."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Deviation, relative_error
from clsplat.opencl.device import Device


def assert_within_bounds(deviations: Iterable[Deviation]) -> None:
    """Fail with a sentence for each deviation beyond its bound, and if there are no deviations."""
    actual = list(deviations)
    assert actual
    assert not [deviation.text for deviation in actual if not deviation.passes]


def assert_schedules_agree(device: Device, actual: NDArray[np.float32], expected: NDArray[np.float32]) -> None:
    """Fail if the schedules compute different values: on a CPU, other bits; a GPU's compiler may fuse
    multiplications and additions in one schedule that it leaves apart in the other.
    """
    if device.info.kind == "CPU":
        np.testing.assert_array_equal(actual, expected)
    else:
        assert relative_error(actual, expected) < 1e-5
