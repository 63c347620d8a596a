"""scan.cl, sort_radix.cl and sort_bitonic.cl against NumPy."""

import numpy as np
import pytest

from clsplat.render.tiles import Tiler
from clsplat.render.workspace import Workspace

# around the team's run (8 * 64), the CPU's shortest run and block, and powers of two
LARGE = tuple(pytest.param(count, marks=pytest.mark.large) for count in (16383, 16384, 16385, 70001))
COUNTS = (1, 2, 7, 63, 64, 65, 511, 512, 513, 1023, 1024, 1025, *LARGE)


def tiler_of(device, sort="radix") -> Tiler:
    return Tiler(device, Workspace(device), sort)


@pytest.mark.parametrize("count", [0, *COUNTS])
def test_scan(device, rng, count):
    values = rng.integers(0, 100, count).astype(np.uint32)
    offsets = tiler_of(device).scan(device.upload(values), count, "test").get()
    np.testing.assert_array_equal(offsets, np.concatenate([[0], np.cumsum(values)]))


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("bits", [1, 9, 12, 32])
def test_radix_is_a_stable_sort(device, rng, count, bits):
    keys = rng.integers(0, 2**bits, count, dtype=np.uint64).astype(np.uint32)
    sorted_keys, places = tiler_of(device).sort_pairs(device.upload(keys), bits, count, "test")
    expected = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(places.get(), expected)
    np.testing.assert_array_equal(sorted_keys.get(), keys[expected])


@pytest.mark.parametrize("keys", ["equal", "descending", "ascending"])
def test_radix_with_orderly_keys(device, keys):
    count = 3000
    values = {"equal": np.full(count, 7), "descending": np.arange(count)[::-1], "ascending": np.arange(count)}[keys]
    values = values.astype(np.uint32)
    _, places = tiler_of(device).sort_pairs(device.upload(values), 12, count, "test")
    np.testing.assert_array_equal(places.get(), np.argsort(values, kind="stable"))


# tile lengths around the bitonic group, its powers of two and the capacity of local memory (1024 or 2048)
LENGTHS = (0, 1, 2, 3, 5, 63, 64, 65, 127, 128, 1023, 1024, 1025, 0, 2047, 2048, 2049, 4097, 300, 0)


@pytest.mark.parametrize("equal_depths", [False, True])
def test_bitonic_sorts_tiles_of_any_length(device, rng, equal_depths):
    tiles, pairs = len(LENGTHS), sum(LENGTHS)
    pair_tile = rng.permutation(np.repeat(np.arange(tiles), LENGTHS)).astype(np.uint32)
    depth_key = rng.integers(0, 50 if equal_depths else 2**31, pairs).astype(np.uint32)
    pair_splat = np.arange(pairs, dtype=np.uint32)
    upload = device.upload
    offsets, ordered = tiler_of(device, "bitonic")._sort_in_tiles(
        upload(pair_tile), upload(pair_splat), upload(depth_key), pairs, tiles
    )
    np.testing.assert_array_equal(offsets.get(), np.concatenate([[0], np.cumsum(LENGTHS)]))
    np.testing.assert_array_equal(ordered.get(), np.lexsort((pair_splat, depth_key, pair_tile)))
