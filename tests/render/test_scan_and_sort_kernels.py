"""scan.cl, sort_radix.cl and sort_bitonic.cl against NumPy."""

import numpy as np
import pytest

from clsplat.conformance.checks.tiles import bitonic_figures, radix_figures, scan_figure, tiler_of
from tests.support.figures import hold

# around the team's run (8 * 64), the CPU's shortest run and block, and powers of two
LARGE = tuple(pytest.param(count, marks=pytest.mark.large) for count in (16383, 16384, 16385, 70001, 525_000))
COUNTS = (1, 2, 7, 63, 64, 65, 511, 512, 513, 1023, 1024, 1025, *LARGE)


@pytest.mark.parametrize("count", [0, *COUNTS])
def test_scan(device, rng, count):
    values = rng.integers(0, 100, count).astype(np.uint32)
    hold([scan_figure(device, values)])


@pytest.mark.parametrize("before", [0, 3, 511, pytest.param(70_000, marks=pytest.mark.large)])
def test_sums_of_a_scan_stay_at_the_largest_number(device, before):
    """Where sums would wrap they end at 2^32 - 1: in an item, a group, and behind the sums of other groups."""
    values = np.ones(before + 4, np.uint32)
    values[[0, -2, -1]] = 2**31, 2**31 - 3, 5
    hold([scan_figure(device, values)])
    assert tiler_of(device).scan(device.upload(values), len(values), "test").get()[-1] == 2**32 - 1
    hold([scan_figure(device, np.array([2**31, 2**31, 5], np.uint32))])


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("bits", [1, 9, 12, 32])
def test_radix_is_a_stable_sort(device, rng, count, bits):
    keys = rng.integers(0, 2**bits, count, dtype=np.uint64).astype(np.uint32)
    hold(radix_figures(device, keys, bits))


@pytest.mark.parametrize("keys", ["equal", "descending", "ascending"])
def test_radix_with_orderly_keys(device, keys):
    count = 3000
    values = {"equal": np.full(count, 7), "descending": np.arange(count)[::-1], "ascending": np.arange(count)}[keys]
    hold(radix_figures(device, values.astype(np.uint32), 12))


# tile lengths around the bitonic group, its powers of two and the capacity of local memory (1024 or 2048)
LENGTHS = (0, 1, 2, 3, 5, 63, 64, 65, 127, 128, 1023, 1024, 1025, 0, 2047, 2048, 2049, 4097, 300, 0)


@pytest.mark.parametrize("equal_depths", [False, True])
def test_bitonic_sorts_tiles_of_any_length(device, rng, equal_depths):
    hold(bitonic_figures(device, rng, LENGTHS, 50 if equal_depths else 2**31))
