"""peak.cl: the benchmark kernels compute what they are counted as."""

import numpy as np
import pytest

from clsplat.conformance.bench.cases import measure_peaks
from tests.support.devices import on_devices, on_one_setting


@on_devices("items", [1, 17, 64, 65])
def test_multiply_add_kernel_matches_numpy(device, items):
    lanes, group = (int(device.tuning[name]) for name in ("LANES", "GROUP"))
    whole = -(-items // group) * group
    result = device.empty(whole * lanes)
    device.program("peak.cl").peak_fma(items=items, result=result, factor=0.5, rounds=5)
    chains = np.arange(whole)[:, None] + np.arange(8.0)
    for _ in range(5):
        chains = chains * 0.5 + 0.25
    np.testing.assert_allclose(result.get(), np.repeat(chains.sum(axis=1), lanes), rtol=1e-6)


@on_devices("items", [1, 17, 64, 65])
def test_exponential_kernel_matches_numpy(device, items):
    lanes, group = (int(device.tuning[name]) for name in ("LANES", "GROUP"))
    whole = -(-items // group) * group
    result = device.empty(whole * lanes)
    device.program("peak.cl").peak_exp(items=items, result=result, step=1e-3, rounds=4)
    x = -0.01 * (np.arange(whole) % 8)
    expected = sum(np.exp(x - 1e-3 * k) + np.exp(x - 0.5 - 1e-3 * k) for k in range(4))
    np.testing.assert_allclose(result.get(), np.repeat(expected, lanes), rtol=1e-5)


@on_devices("groups", [1, 2, 5])
def test_copies(device, rng, groups):
    copy = device.program("peak.cl").peak_copy
    items = groups * copy.group[0]
    values = rng.normal(size=items * max(int(device.tuning["LANES"]), 4)).astype(np.float32)
    copied = device.zeros(len(values))
    copy(items=items, values=device.upload(values), copied=copied)
    np.testing.assert_array_equal(copied.get(), values)


@pytest.mark.large
@on_one_setting
def test_peaks_are_positive(device):
    peaks = measure_peaks(device, repeats=1)
    assert min(peaks.gflops, peaks.gexp, peaks.gbytes) > 0
