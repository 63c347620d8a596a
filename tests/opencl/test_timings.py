"""Kernel timings: only of sampled steps, and in the order of all other commands."""

import numpy as np


def test_kernels_are_timed_only_while_sampling_and_in_order(device):
    array, profiling = device.zeros(1 << 16, np.uint32), []
    device.timings.take()
    for number in range(1, 41):
        device.timings.sampling = number % 4 == 0
        profiling.append(bool(device.queue.properties))
        array.fill(number)
        if number % 7 == 0:
            assert (array.get() == number).all()
    device.timings.sampling = False
    assert profiling == [number % 4 == 0 for number in range(1, 41)]
    ((label, _), seconds), *others = device.timings.take().items()
    assert (label, len(seconds), others) == ("fill.cl:fill_words", 10, [])
    assert all(time >= 0 for time in seconds)
    assert (array.get() == 40).all()
