"""Check prefix sums, sorts and tile lists, whose results are exact."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Deviation, Results, count_true, match
from clsplat.conformance.scenes import Case, random_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.render.tiles import SORT_CAPACITY, Sort, Tiler
from clsplat.render.workspace import Workspace

CHECKS = Checks()
# around the length of a run in common.h
LENGTHS = (0, 1, 2, 3, 127, 128, 129, 1023, 1024, 1025, 0, 2047, 2048, 2049, 4097, 300, 0)
# around the run of a team (8 * 64), and the shortest run of one item
COUNTS = (1, 63, 64, 65, 511, 513, 1025, 16385, 40001)


def make_tiler(device: Device, sort: Sort = "radix") -> Tiler:
    return Tiler(device, Workspace(device), sort)


def check_scan(device: Device, values: NDArray[Any]) -> Deviation:
    """Compare an exclusive prefix sum that saturates at the largest uint32."""
    offsets = make_tiler(device).scan(device.upload(values), len(values), "test").get()
    expected = np.minimum(np.concatenate([[0], np.cumsum(values, dtype=np.uint64)]), 2**32 - 1).astype(np.uint32)
    return match("scan_offsets", f"sums of {len(values)} values", offsets, expected)


def check_radix(device: Device, keys: NDArray[Any], bits: int) -> Results:
    """Compare stable sorts of keys below 2^bits: of all keys, and of the first keys, up to a count in device memory."""
    for count, label in ((len(keys), ""), (len(keys) * 3 // 4, f" of {len(keys)}")):
        key_count = device.upload(np.array([count], np.uint32)) if label else None
        tiler, inputs = make_tiler(device), (device.upload(keys), bits, len(keys), "test", key_count)
        sorted_keys, order, first = tiler.sort_pairs(*inputs)
        expected = np.argsort(keys[:count], kind="stable")
        title = f"{count}{label} keys of {bits} bits"
        yield match("radix_scatter", f"positions of {title}", order.get()[:count], expected)
        yield match("radix_scatter", f"order of {title}", sorted_keys.get()[:count], keys[expected])
        carried = np.arange(len(keys), dtype=np.uint32)[::-1] * 3
        actual = tiler.sort_pairs(*inputs, carried=device.upload(carried))[0].get()[:count]
        yield match("radix_scatter", f"values carried with {title}", actual, carried[expected])
        if 2**bits == first.shape[0] - 1:  # one pass
            expected_offsets = np.searchsorted(keys[expected], np.arange(2**bits + 1))
            yield match("radix_scatter", f"first positions of {title}", first.get(), expected_offsets)


def check_bitonic(device: Device, rng: np.random.Generator, lengths: tuple[int, ...], max_key: int) -> Results:
    """Check the sort of each tile's pairs by depth key and then by index.

    lengths: number of pairs in each tile; max_key: bound on the depth keys, exclusive.
    """
    tiles, pairs = len(lengths), sum(lengths)
    pair_tile = rng.permutation(np.repeat(np.arange(tiles), lengths)).astype(np.uint32)
    depth_key = rng.integers(0, max_key, pairs).astype(np.uint32)
    pair_splat = np.arange(pairs, dtype=np.uint32)
    upload = device.upload
    capacity = pairs + 70  # the device reads the number of pairs
    tile_slots, splat_slots = (upload(np.append(array, np.zeros(70, np.uint32))) for array in (pair_tile, pair_splat))
    pair_counts = upload(np.array([pairs], np.uint32)), upload(np.array(lengths, np.uint32))
    offsets, sorted_pairs = make_tiler(device, "bitonic")._sort_in_tiles(
        tile_slots, splat_slots, upload(depth_key), *pair_counts, capacity, tiles
    )
    actual = offsets.get()
    yield match("scan_offsets", "offsets of tiles", actual, np.concatenate([[0], np.cumsum(lengths)]))
    yield match("fill_tiles", "pairs that are not in their tile", pair_counts[1].get(), 0)
    expected, actual = np.lexsort((pair_splat, depth_key, pair_tile)), sorted_pairs.get()[:pairs]
    is_long = np.repeat(np.array(lengths) > SORT_CAPACITY, lengths)
    for kernel, mask in (("sort_tiles", ~is_long), ("merge_runs", is_long)):
        title = f"order of {mask.sum()} of {pairs} pairs in {tiles} tiles"
        yield match(kernel, title, actual[mask], expected[mask])


@CHECKS.add("scan_blocks", "scan_offsets")
def scans(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield check_scan(device, rng.integers(0, 100, count).astype(np.uint32))
    yield check_scan(device, rng.integers(0, 2**31, 40_001, dtype=np.uint32))  # sums that would overflow


@CHECKS.add("radix_count", "radix_scatter")
def radix_sort(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        for bits in (9, 32):
            keys = rng.integers(0, 2**bits, count, dtype=np.uint64).astype(np.uint32)
            yield from check_radix(device, keys, bits)
    for special_keys in (np.full(3000, 7), np.arange(3000)[::-1]):
        yield from check_radix(device, special_keys.astype(np.uint32), 12)


@CHECKS.add("find_tile_offsets")
def many_tiles(device: Device, rng: np.random.Generator) -> Results:
    """Check the offsets of more tiles than any schedule sorts in one pass."""
    tiles = 5000
    pair_tile = rng.integers(0, tiles, 3000).astype(np.uint32)
    inputs = device.upload(pair_tile), device.upload(np.array([2900], np.uint32)), len(pair_tile), tiles
    offsets, order = make_tiler(device)._sort_by_tile(*inputs)
    expected = np.argsort(pair_tile[:2900], kind="stable")
    yield match("radix_scatter", "order of 2900 pairs in 5000 tiles", order.get()[:2900], expected)
    expected_offsets = np.searchsorted(pair_tile[expected], np.arange(tiles + 1))
    yield match("find_tile_offsets", "offsets of 5000 tiles", offsets.get(), expected_offsets)


@CHECKS.add("fill_tiles", "sort_tiles", "merge_runs")
def bitonic_sort(device: Device, rng: np.random.Generator) -> Results:
    for max_key in (50, 2**31):
        yield from check_bitonic(device, rng, LENGTHS, max_key)


@CHECKS.add("count_large", "emit_large", "emit_pairs")
def tile_lists(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((1, 16, 16), (60, 17, 15), (150, 100, 70), (64, 5, 3), (40, 210, 130)):
        case = random_case(rng, count, width, height)
        case.parameters["log_scales"][: count // 10] += 1.5
        case.parameters["means"][: count // 3] = case.parameters["means"][count // 3 : 2 * (count // 3)]  # equal depths
        for sort in ("radix", "bitonic"):
            yield from check_list(device, case, sort, f"{count} Gaussians, {width} x {height} px, {sort}")


def check_list(device: Device, case: Case, sort: Sort, label: str) -> Results:
    """Check that each tile lists, exactly once and front to back, every splat that reaches it, and few other splats."""
    rasterizer = Rasterizer(device, sort)
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    lists, tiles, count = frame.lists, frame.camera.tiles, len(case.parameters["means"])
    keys = rasterizer.workspace.array("depth_key", count, np.uint32).get()
    splats, offsets = lists.pair_splat.get()[: lists.pairs], lists.tile_offset.get()[: tiles + 1]
    tile_splats = splats[np.minimum(lists.tile_pairs.get()[: lists.pairs], max(lists.pairs, 1) - 1)]
    kernel = "find_tile_offsets" if sort == "radix" else "fill_tiles"
    yield count_true(kernel, f"offsets of tiles, {label}", np.diff(offsets.astype(np.int64), append=lists.pairs) < 0)
    tile = np.repeat(np.arange(tiles), np.maximum(np.diff(offsets.astype(np.int64)), 0))[: lists.pairs]
    if len(tile) < lists.pairs:
        yield count_true(kernel, f"pairs outside all tiles, {label}", np.ones(lists.pairs - len(tile)))
        return
    sorted_order = np.lexsort((tile_splats, keys[tile_splats], tile))
    kernel = "radix_scatter" if sort == "radix" else "sort_tiles"
    yield match(kernel, f"order in tiles, {label}", sorted_order, np.arange(lists.pairs))
    list_counts = np.zeros((tiles, count), int)
    np.add.at(list_counts, (tile, tile_splats), 1)
    yield count_true("emit_pairs", f"pairs listed twice, {label}", list_counts > 1)
    max_alpha, is_decisive = _max_alpha(frame, case)
    yield count_true("emit_pairs", f"missing pairs, {label}", (max_alpha >= 1.0001 / 255) & (list_counts == 0))
    is_superfluous = is_decisive & (max_alpha <= 0.95 / 255) & (list_counts > 0)
    yield count_true("emit_pairs", f"superfluous pairs, {label}", is_superfluous)
    pairs = np.bincount(splats, minlength=count)
    tile_count = lists.tile_count.get()[:count]
    yield match("emit_pairs", f"number of pairs of each Gaussian, {label}", pairs, tile_count)
    first = lists.first_pair.get()[:count][tile_count > 0]
    yield match("emit_pairs", f"first pairs, {label}", splats[first], np.flatnonzero(tile_count))


def _max_alpha(frame: Frame, case: Case) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the largest alpha of each record in each tile, and a mask of the pairs that must reach a pixel, [T, N].

    Other pairs may be listed with any alpha, because the tile extends beyond the image, or the splat is thinner than a
    few pixels.
    """
    records, camera = frame.splats.get().astype(np.float64), frame.camera
    (width, height), tile = case.size, camera.tile
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    max_alpha = np.zeros((camera.tiles, len(records)))
    is_complete = np.zeros(camera.tiles, bool)
    for n, record in enumerate(records):
        dx, dy = record[0] - x, record[1] - y
        power = -0.5 * (record[2] * dx**2 + record[4] * dy**2) - record[3] * dx * dy
        alpha = record[5] * np.exp(np.minimum(power, 0))
        for t in range(camera.tiles):
            row, column = divmod(t, camera.tiles_x)
            tile_alpha = alpha[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile]
            max_alpha[t, n] = tile_alpha.max()
            is_complete[t] = tile_alpha.shape == (tile, tile)
    is_thin = np.minimum(records[:, 12] - records[:, 11], records[:, 10] - records[:, 9]) < 4
    return max_alpha, is_complete[:, None] & ~is_thin


# Splats that reach more tiles than a mask has bits; the items of a group share the work on their rectangles.

TALL_RECTANGLE = (3, 130)  # tiles: two or three rows for each of 64 items, none for the last
MASK_SIZED = ((8, 4), (11, 3))  # tiles: as many as a mask has bits, and one more
COUNT_ERRORS = (-7, -1, 5)  # errors in a count, as another compiler might cause
UNTOUCHED_VALUE = 0xDEADBEEF


def large_case(device: Device, rng: np.random.Generator, columns: int, rows: int, count: int = 6) -> Case:
    """Return a case of Gaussians half as large as the image's longer side; every third is ten times smaller.

    columns, rows: size of the image, in tiles.
    """
    tile = int(device.tuning["TILE"])
    width, height, side = columns * tile, rows * tile, max(columns, rows) * tile
    case = random_case(rng, count, side, side)
    case.parameters["log_scales"] += np.log(side / 6 / np.where(np.arange(count) % 3 == 2, 5, 1))[:, None]
    camera = replace(case.view.camera, width=width, height=height, cx=0.5 * width, cy=0.5 * height)
    return replace(case, view=replace(case.view, camera=camera))


@CHECKS.add("count_large", "emit_large", "project_forward")
def lists_of_large_splats(device: Device, rng: np.random.Generator) -> Results:
    yield from check_large(device, rng)


def check_large(device: Device, rng: np.random.Generator) -> Results:
    """Check tile lists for many rows of tiles, for splats that reach about 32 tiles, and for wrong counts."""
    for columns, rows in (TALL_RECTANGLE, *MASK_SIZED):
        case, label = large_case(device, rng, columns, rows), f"large Gaussians, {columns} x {rows} tiles"
        yield from check_list(device, case, "radix", label)
    yield from check_wrong_counts(device, large_case(device, rng, *TALL_RECTANGLE))


def check_wrong_counts(device: Device, case: Case) -> Results:
    """Check that each large splat is listed in as many distinct tiles as its `tile_count`, even if that is wrong."""
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    gaussian_count, camera = len(case.parameters["means"]), frame.camera
    box = rasterizer.workspace.array("tile_box", gaussian_count, np.uint32)
    actual = frame.lists.tile_count.get()[:gaussian_count].astype(int)
    is_large = (box.get() >> 24 == 33) & (actual > 0)
    for extra in COUNT_ERRORS:
        counts = np.where(is_large, np.maximum(1, actual + extra), 0)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        arrays = [device.upload(np.full(offsets[-1] + 64, UNTOUCHED_VALUE, np.uint32)) for _ in range(2)]
        device.program("large.cl").emit_large(
            groups=1,
            splats=frame.splats,
            tile_box=box,
            tile_count=device.upload(counts.astype(np.uint32)),
            first_pair=device.upload(offsets[:-1].astype(np.uint32)),
            pair_count=device.upload(offsets[-1:].astype(np.uint32)),
            pair_tile=arrays[0],
            pair_splat=arrays[1],
            tile_pair_count=device.zeros(camera.tiles, np.uint32),
            tiles_x=camera.tiles_x,
            row_begin=0,
            row_end=camera.tiles_y,
            run=gaussian_count,
            count=gaussian_count,
        )
        tile, splat = (array.get() for array in arrays)
        label = f"large Gaussians counted with {extra:+d} tiles"
        owner = np.repeat(np.arange(gaussian_count), counts)
        yield match("emit_large", f"splats of {label}", splat, np.append(owner, np.full(64, UNTOUCHED_VALUE)))
        yield count_true("emit_large", f"tiles outside, {label}", tile[: len(owner)] >= camera.tiles)
        yield match("emit_large", f"values after {label}", tile[len(owner) :], UNTOUCHED_VALUE)
        pairs = np.stack([owner, tile[: len(owner)]], axis=1)
        duplicate_count = len(pairs) - len(np.unique(pairs, axis=0)) - int(np.maximum(0, counts - camera.tiles).sum())
        yield Deviation("emit_large", f"tiles listed twice, {label}", max(0, duplicate_count), 0, counts=True)
