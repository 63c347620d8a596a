"""fill.cl."""

from types import SimpleNamespace

import numpy as np

from clsplat.opencl import device as program
from clsplat.opencl.device import Array
from tests.support.devices import each_once, on_devices


@on_devices(
    "count, dtype, value",
    each_once(
        [0, 1, 15, 16, 17, 1023, 1024, 1025], [(np.float32, 0.0), (np.float32, -1.5), (np.uint32, 7), (np.uint32, 0)]
    ),
)
def test_fill_sets_every_element(device, count, dtype, value):
    array = device.upload(np.full(count, 3, dtype))
    array.fill(value)
    np.testing.assert_array_equal(array.get(), np.full(count, value, dtype))


@on_devices("count, lines", [(2**32, 2**28), (2**32 + 1, 2**28 + 1), (2**33 - 16, 2**29 - 1)])
def test_word_count_may_exceed_32_bits(device, monkeypatch, count, lines):
    """A stand-in for the queue takes the launch: the buffer is small."""
    launched = []
    device.program("fill.cl")  # built before the stand-in takes its place
    queue = SimpleNamespace(**vars(program.cl) | {"enqueue_nd_range_kernel": lambda *launch: launched.append(launch)})
    monkeypatch.setattr(program, "cl", queue)
    Array(device, device.empty(16).buffer, (count,), np.dtype(np.float32)).fill(1.5)
    ((_, _, (items,), (group,)),) = launched
    assert items == -(-lines // group) * group
