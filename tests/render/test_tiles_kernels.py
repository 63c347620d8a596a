"""pairs.cl and the tile lists: complete, without duplicates, and equal for both sorts.

scan.cl, sort_radix.cl and sort_bitonic.cl are compared with NumPy.
"""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.checks.tiles import check_bitonic, check_radix, check_scan, make_tiler
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import DataError
from clsplat.opencl import device as program
from clsplat.opencl.device import Device
from clsplat.render.camera import camera_values
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.tiles import COUNTING, Band, Footprints
from clsplat.scene.camera import MAX_SIDE
from tests.support.deviations import assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting, product


def tile_lists(device, case, sort):
    rasterizer = Rasterizer(device, sort)
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    lists = frame.lists
    tiles = frame.camera.tiles
    splats = lists.pair_splat.get()
    offsets = lists.tile_offset.get()[: tiles + 1]
    order = lists.tile_pairs.get()
    return frame, [splats[order[offsets[t] : offsets[t + 1]]] for t in range(tiles)]


def alpha_of(record, width, height):
    """Alpha of a splat at every pixel, float64, [height, width]."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    dx, dy = record[0] - x, record[1] - y
    power = -0.5 * (record[2] * dx**2 + record[4] * dy**2) - record[3] * dx * dy
    return record[5] * np.exp(np.minimum(power, 0))


@on_devices("count, width, height", [(0, 40, 30), (1, 16, 16), (60, 17, 15), (150, 100, 70), (64, 5, 3)])
def test_every_visible_pixel_is_in_a_listed_tile(device, rng, count, width, height):
    case = random_case(rng, count, width, height)
    frame, tiles = tile_lists(device, case, "radix")
    records, tile = frame.splats.get().astype(np.float64), frame.camera.tile
    listed = [set(t.tolist()) for t in tiles]
    assert all(len(s) == len(t) for s, t in zip(listed, tiles, strict=True))
    for n, record in enumerate(records):
        alpha = alpha_of(record, width, height) if record[5] > 0 else np.zeros((height, width))
        for ty in range(frame.camera.tiles_y):
            for tx in range(frame.camera.tiles_x):
                strongest = alpha[ty * tile : (ty + 1) * tile, tx * tile : (tx + 1) * tile].max()
                member = n in listed[ty * frame.camera.tiles_x + tx]
                if strongest >= 1 / 255:
                    assert member, (n, tx, ty)
                # a tile inside the image is listed only where the splat almost reaches alpha 1/255
                inside = (tx + 1) * tile <= width and (ty + 1) * tile <= height
                if member and inside:
                    assert strongest > 0.95 / 255 or min(record[12] - record[11], record[10] - record[9]) < 4


@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.parametrize("side", ["width", "height"])
def test_image_with_more_tiles_than_a_pair_can_name_is_refused(rng, tile, side):
    """`tile_box` of tiles.h has 12 bits for each of a tile's column and row."""
    view = random_case(rng, 1).view
    largest = replace(view, camera=replace(view.camera, **{side: 4096 * tile}))
    assert camera_values(largest, tile)["tiles_x" if side == "width" else "tiles_y"] == 4096
    with pytest.raises(DataError, match=rf"view: .*{4096 * tile + 1}.* at most {4096 * tile} per side"):
        camera_values(replace(view, camera=replace(view.camera, **{side: 4096 * tile + 1})), tile)


@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.parametrize(("size", "fits"), [((2**15, 2**15), True), ((2**15, 2**15 + 1), False), ((1, 2**15), True)])
def test_image_with_more_pixels_than_kernels_index_is_refused(rng, tile, size, fits):
    """Four planes, of a blur, reach 2^32 values."""
    view = random_case(rng, 1).view
    width, height = size
    large = replace(view, camera=replace(view.camera, width=width, height=height))
    if fits:
        camera_values(large, tile)
    else:
        with pytest.raises(DataError, match=rf"view: the camera is {width}x{height} pixels; expected at most "):
            camera_values(large, tile)


def test_readers_accept_no_more_tiles_than_devices_can_name(rng):
    view = random_case(rng, 1).view
    camera_values(replace(view, camera=replace(view.camera, width=MAX_SIDE, height=MAX_SIDE).check()), 8)


@on_devices("count", [0, 1, 65, 500])
def test_both_sorts_list_front_to_back(device, rng, count):
    case = random_case(rng, count, 100, 70)
    case.parameters["means"][: count // 3] = case.parameters["means"][count // 3 : 2 * (count // 3)]  # equal depths
    frame, radix = tile_lists(device, case, "radix")
    depth = case.project().depth
    _, bitonic = tile_lists(device, case, "bitonic")
    for a, b in zip(radix, bitonic, strict=True):
        np.testing.assert_array_equal(a, b)
        if len(a) > 1:
            assert (np.diff(depth[a]) >= -1e-6 * depth[a][1:]).all()
    assert frame.lists.pairs == sum(map(len, radix))


@on_one_setting
def test_auto_measures_and_agrees(device, rng):
    case = random_case(rng, 100, 60, 50)
    _, chosen = tile_lists(device, case, "auto")
    _, radix = tile_lists(device, case, "radix")
    for a, b in zip(chosen, radix, strict=True):
        np.testing.assert_array_equal(a, b)


@on_devices("surplus", [-7, -1, 0, 1, 7, 1000])
def test_large_splats_list_as_many_tiles_as_were_counted(device, rng, surplus):
    """Whatever another compiler counted, emission stays inside its places and leaves none open."""
    case = random_case(rng, 12, 150, 130)
    case.parameters["log_scales"][:8] += 2.5
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    camera, array = frame.camera, rasterizer.workspace._arrays
    box, mask, count = (array[name].get()[:12] for name in ("tile_box", "tile_mask", "tile_count"))
    touched = [set(_emitted(device, frame, box, mask, count)[n]) for n in range(12)]
    large = (count > 0) & (box >> 24 == 33)
    assert large.any()
    counted = np.where(large, np.maximum(1, count.astype(int) + surplus), count).astype(np.uint32)
    for n, tiles in enumerate(_emitted(device, frame, box, mask, counted)):
        assert len(tiles) == counted[n]
        assert max(tiles, default=0) < camera.tiles
        if counted[n] <= count[n]:
            assert set(tiles) <= touched[n]
        else:
            assert set(tiles) >= touched[n]
        assert len(set(tiles)) == min(len(tiles), camera.tiles)


@on_devices("rounds", ["(touched[lane] && (row + column + lane) % 3 != 1)", "1"])
def test_listing_and_counting_may_disagree(device, rng, monkeypatch, rounds):
    """As where a compiler rounds differently there: every place has one writer, and a tile of its own in the image."""
    case = random_case(rng, 12, 150, 130)
    case.parameters["log_scales"][:8] += 2.5
    expected = _listed(device, case)
    flatten, text = program.flatten, "if (touched[lane] || "

    def other(path, seen=None):
        flat = flatten(path, seen)
        assert path.name != "large.cl" or flat.count(text) == 1
        return flat.replace(text, f"if ({rounds} || ")

    monkeypatch.setattr(program, "flatten", other)
    different = Device(device.info, device.schedule)
    different.tuning.update(device.tuning)
    result = _listed(different, case)
    assert result == _listed(different, case) != expected
    for tiles, before in zip(result, expected, strict=True):
        assert len(tiles) == len(set(tiles)) == len(before)
        assert max(tiles, default=0) < case.device_camera(device).tiles


@on_devices("surplus, sort", product([-1, 1], ["radix", "bitonic"]))
def test_miscounted_large_splat_is_blended_once(device, rng, monkeypatch, sort, surplus):
    """It fills its rectangle at the left edge: the surplus place names a tile outside, where it adds nothing."""
    case = random_case(rng, 12, 400, 300)
    pose = case.view.world_to_camera
    case.parameters["means"][0] = ([-0.8, 0, 1.5] - pose[:, 3]) @ pose[:, :3]
    case.parameters["quats"][0], case.parameters["logit_opacity"][0] = [1, 0, 0, 0], 3
    case.parameters["log_scales"][0] = [-2, 2, -4]
    model, camera = case.model(device), case.device_camera(device)
    rasterizer = Rasterizer(device, sort)
    gradient = device.upload(rng.normal(0, 1, (3, camera.rows, camera.stride)).astype(np.float32))
    expected = rasterizer.forward(model, camera, device.zeros(3))
    image, pairs = expected.image.get(), expected.lists.pairs
    sums = rasterizer.pixel_sums(model, expected, gradient).get()[:, :12]

    kernels = device.program("large.cl", **COUNTING[sort]).kernels
    correct = kernels["count_large"]

    def miscount(**values):
        correct(**values)
        count = values["tile_count"].get()
        assert count[0] > 32
        count[0] = int(count[0]) + surplus
        values["tile_count"].set(count)

    monkeypatch.setitem(kernels, "count_large", miscount)
    frame = rasterizer.forward(model, camera, device.zeros(3))
    lists = frame.lists
    assert lists.pairs == pairs + surplus
    tile = np.repeat(np.arange(frame.camera.tiles), np.diff(lists.tile_offset.get()))
    names = np.stack([tile, lists.pair_splat.get()[lists.tile_pairs.get()[: lists.pairs]]])
    assert len(np.unique(names, axis=1)[0]) == lists.pairs
    if surplus > 0:
        np.testing.assert_array_equal(frame.image.get(), image)
        np.testing.assert_array_equal(rasterizer.pixel_sums(model, frame, gradient).get()[:, :12], sums)
    else:
        changed = (frame.image.get() != image).any(axis=0).reshape(camera.tiles_y, camera.tile, camera.tiles_x, -1)
        assert changed.any(axis=(1, 3)).sum() <= 1  # the tile that is missing


def _emitted(device, frame, box, mask, count):
    """Tiles of each Gaussian that emit_pairs lists for these counts; nothing else may be written."""
    offset = np.concatenate([[0], np.cumsum(count)]).astype(np.uint32)
    guarded, untouched = int(offset[-1]) + 64, np.uint32(0xDEADBEEF)
    pair_tile, pair_splat = (device.upload(np.full(guarded, untouched)) for _ in range(2))
    first_pair = device.zeros(len(count), np.uint32)
    written = {"first_pair": first_pair, "pair_tile": pair_tile, "pair_splat": pair_splat}
    written["pair_count"] = device.zeros(2, np.uint32)
    written["tile_count"] = device.upload(count)
    written["tile_pair_count"] = device.zeros(frame.camera.tiles, np.uint32)
    size = {"tile_box": device.upload(box), "tiles_x": frame.camera.tiles_x, "count": len(count)}
    device.program("pairs.cl").emit_pairs(
        items=len(count),
        tile_mask=device.upload(mask),
        order=device.upload(np.arange(len(count), dtype=np.uint32)),
        pair_offset=device.upload(offset),
        capacity=int(offset[-1]),
        **written,
        **size,
    )
    device.program("large.cl").emit_large(
        groups=1,
        splats=frame.splats,
        row_begin=0,
        row_end=frame.camera.tiles_y,
        run=len(count),
        **written,
        **size,
    )
    tiles, splats = pair_tile.get(), pair_splat.get()
    assert (tiles[offset[-1] :] == untouched).all()
    np.testing.assert_array_equal(splats[: offset[-1]], np.repeat(np.arange(len(count)), count))
    return [tiles[offset[n] : offset[n + 1]].tolist() for n in range(len(count))]


def _listed(device, case):
    """Tiles of each Gaussian, with some large ones."""
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    actual = (rasterizer.workspace._arrays[name].get()[:12] for name in ("tile_box", "tile_mask", "tile_count"))
    box, mask, count = actual
    assert ((count > 0) & (box >> 24 == 33)).any()
    return _emitted(device, frame, box, mask, count)


# around the team's run (8 * 64), the CPU's shortest run and block, and powers of two
LARGE = tuple(pytest.param(count, marks=pytest.mark.large) for count in (16383, 16384, 70001, 525_000))
COUNTS = (2, 7, 64, 512, 1023, 1024, *LARGE)


@on_devices("count", [0, *COUNTS])
def test_scan(device, rng, count):
    values = rng.integers(0, 100, count).astype(np.uint32)
    assert_within_bounds([check_scan(device, values)])


@on_devices("before", [0, 3, 511, pytest.param(70_000, marks=pytest.mark.large)])
def test_scan_saturates_at_the_largest_number(device, before):
    """Where sums would wrap they end at 2^32 - 1: in an item, a group, and behind the sums of other groups."""
    values = np.ones(before + 4, np.uint32)
    values[[0, -2, -1]] = 2**31, 2**31 - 3, 5
    assert_within_bounds([check_scan(device, values)])
    assert make_tiler(device).scan(device.upload(values), len(values), "test").get()[-1] == 2**32 - 1
    assert_within_bounds([check_scan(device, np.array([2**31, 2**31, 5], np.uint32))])


@on_devices("count, bits", each_once(COUNTS, [1, 9, 12, 32]))
def test_radix_is_a_stable_sort(device, rng, count, bits):
    keys = rng.integers(0, 2**bits, count, dtype=np.uint64).astype(np.uint32)
    assert_within_bounds(check_radix(device, keys, bits))


@on_devices("keys", ["equal", "ascending", "descending"])
def test_radix_with_sorted_keys(device, keys):
    count = 3000
    values = {"equal": np.full(count, 7), "descending": np.arange(count)[::-1], "ascending": np.arange(count)}[keys]
    assert_within_bounds(check_radix(device, values.astype(np.uint32), 12))


# around the bitonic group and its powers of two, and the number of pairs of a run, SORT_CAPACITY
LENGTHS = (0, 1, 2, 3, 5, 63, 64, 65, 127, 128, 129, 1023, 1024, 1025, 0, 2047, 2048, 2049, 4095, 4096, 4097, 300, 0)


@on_devices("equal_depths", [False, True])
def test_bitonic_sorts_tiles_of_any_length(device, rng, equal_depths):
    assert_within_bounds(check_bitonic(device, rng, LENGTHS, 50 if equal_depths else 2**31))


@pytest.mark.large
@on_devices("lengths", [[50_000], [1, 50_000, 700, 0, 1025], [0, 3000, 0, 50_000]])
def test_bitonic_sorts_the_longest_lists(device, rng, lengths):
    assert_within_bounds(check_bitonic(device, rng, lengths, 20_000))


@on_devices("width, height, count, pairs", [(400, 400, 50_000, 150_643), (1920, 1080, 1_000_000, 3_000_000)])
def test_bitonic_sort_needs_few_launches(device, monkeypatch, width, height, count, pairs):
    launches = []
    tiler = make_tiler(device, "bitonic")
    arrays = [device.zeros(1, np.uint32) for _ in range(4)]
    monkeypatch.setattr(program.Kernel, "__call__", lambda kernel, **_: launches.append(kernel.label))
    monkeypatch.setattr(program.Array, "get_item_later", lambda *_: lambda: pairs)
    band = Band(-(-width // 16), -(-height // 16), 0, -(-height // 16))
    for _ in range(2):  # the first call allocates memory, and fills it
        launches.clear()
        tiler.build(device.empty(1), Footprints(*arrays), band, count, 2**31)
    assert 8 < len(launches) <= 12
