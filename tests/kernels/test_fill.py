"""fill.cl."""

import numpy as np
import pytest


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 1023, 1024, 1025])
@pytest.mark.parametrize(("dtype", "value"), [(np.float32, 0.0), (np.float32, -1.5), (np.uint32, 7), (np.uint32, 0)])
def test_fill(device, count, dtype, value):
    array = device.upload(np.full(count, 3, dtype))
    array.fill(value)
    np.testing.assert_array_equal(array.get(), np.full(count, value, dtype))
