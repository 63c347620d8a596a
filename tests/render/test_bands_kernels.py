"""Bands of tiles and short launches give the same bits as one launch."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import MemoryLimitError
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import MAX_PAIRS, Rasterizer, RenderLimits
from clsplat.render.tiles import Band, Footprints, Tiler, TooManyPairs
from clsplat.render.workspace import Workspace
from tests.support.devices import each_once, on_devices, on_one_setting


def results(device, case, weights, budget=None, sort="radix", rasterizer=None):
    rasterizer = rasterizer or Rasterizer(device, sort, budget)
    model, camera = case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(np.array([0.2, 0.5, 0.9], np.float32)))
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    image = frame.image.get()
    pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(planes)).get()[:, : model.gaussians.count]
    return image, pixel_sums, frame


@on_devices(
    "budget, bands, sort",
    each_once(
        [
            (RenderLimits(MAX_PAIRS), 1),
            (RenderLimits(600), 2),
            (RenderLimits(250), 4),
            (RenderLimits(1), 5),
            (RenderLimits(MAX_PAIRS, 3), 1),
            (RenderLimits(1, 1), 5),
            (RenderLimits(250, 1000), 4),
        ],
        ["radix", "bitonic"],
    ),
)
def test_bands_give_the_same_image_and_pixel_sums(device, rng, budget, bands, sort):
    case = random_case(rng, 300, 60, 70)
    case.parameters["log_scales"][:20] += 1.5  # some over many rows of tiles, and too many tiles for a mask
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, frame = results(device, case, weights)
    assert frame.lists.pairs > 600
    banded_image, banded_sums, banded = results(device, case, weights, budget, sort)
    if device.tuning["TILE"] == 16 and bands in (1, 5):
        assert len(banded.bands) == bands
    assert (len(banded.bands) > 1) == (bands > 1)
    np.testing.assert_array_equal(banded_image, image)
    np.testing.assert_array_equal(banded_sums, pixel_sums)


@on_one_setting
def test_empty_band(device, rng):
    case = random_case(rng, 0, 40, 64)
    image, _, _ = results(device, case, 0.0, RenderLimits(1, 2))
    np.testing.assert_allclose(image[:, :64, :40], np.broadcast_to([[[0.2]], [[0.5]], [[0.9]]], (3, 64, 40)), rtol=1e-6)


def limited(device, allocation):
    """The device with smaller buffers, in bytes."""
    other = Device(replace(device.info, allocation=allocation), device.schedule)
    other.tuning.update(device.tuning)
    return other


@on_one_setting
def test_room_to_grow_ends_at_the_largest_buffer(device):
    workspace = Workspace(limited(device, 4096))
    workspace.array("table", 900)
    assert workspace.array("table", 1000).shape == (1000,)
    assert workspace.length("table") == 1024
    with pytest.raises(MemoryLimitError, match="one buffer of"):
        workspace.array("table", 1025)


def test_records_may_fill_the_largest_buffer(device, rng):
    case = random_case(rng, 300, 60, 70)
    case.parameters["log_scales"] += 1.0  # more bytes of records than of any table
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, frame = results(device, case, weights)
    small = limited(device, 64 * frame.lists.pairs)
    rasterizer = Rasterizer(small, "radix")
    first = replace(case, parameters={name: table[:270] for name, table in case.parameters.items()})
    results(small, first, weights, rasterizer=rasterizer)
    limited_image, limited_sums, whole = results(small, case, weights, rasterizer=rasterizer)
    assert len(whole.bands) == 1
    np.testing.assert_array_equal(limited_image, image)
    np.testing.assert_array_equal(limited_sums, pixel_sums)


@on_devices("refused", ["pair_sums", "pair_tile", "tile_pairs", "tile_values0"])
def test_refused_memory_leads_to_bands_with_the_same_bits(device, rng, monkeypatch, refused):
    case = random_case(rng, 300, 60, 70)
    case.parameters["log_scales"][:20] += 1.5
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, frame = results(device, case, weights)
    most, array = frame.lists.pairs // 2, Workspace.array

    def refusing(workspace, name, shape, *dtype, **slack):
        if name == refused and (shape if isinstance(shape, int) else shape[0]) > most:
            raise MemoryLimitError("no memory is left")
        return array(workspace, name, shape, *dtype, **slack)

    monkeypatch.setattr(Workspace, "array", refusing)
    sort = "bitonic" if refused == "tile_pairs" else "radix"
    rasterizer = Rasterizer(device, sort)
    for _ in range(2):  # the second frame begins with bands
        refused_image, refused_sums, _ = results(device, case, weights, rasterizer=rasterizer)
        np.testing.assert_array_equal(refused_image, image)
        np.testing.assert_array_equal(refused_sums, pixel_sums)
    assert max(rasterizer._bands.values()) > 1


@on_devices("missing, sort", each_once([1, None], ["radix", "bitonic"]))
def test_frame_with_too_little_room_is_repeated(device, rng, missing, sort):
    """Room for all pairs but `missing`, or for a single pair."""
    case = random_case(rng, 300, 60, 70)
    case.parameters["log_scales"][:20] += 1.5  # some are listed by another kernel
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, frame = results(device, case, weights)
    pairs, rasterizer = frame.lists.pairs, Rasterizer(device, sort)
    rasterizer.tiler._capacity = pairs - missing if missing else 1
    incomplete = rasterizer.start_forward(case.model(device), case.device_camera(device), device.zeros(3))
    assert not incomplete.lists.tile_offset.get()[: incomplete.camera.tiles + 1].any()
    assert not incomplete.image.get().any()
    rasterizer.tiler._capacity = pairs - missing if missing else 1
    repeated_image, repeated_sums, repeated = results(device, case, weights, rasterizer=rasterizer)
    assert repeated.lists.capacity >= pairs
    np.testing.assert_array_equal(repeated_image, image)
    np.testing.assert_array_equal(repeated_sums, pixel_sums)


@on_one_setting
def test_memory_refused_at_a_copy_leads_to_bands(device, rng, monkeypatch):
    """Some runtimes allocate at the first use."""
    case, copy, refused = random_case(rng, 300, 60, 70), cl.enqueue_copy, []
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, _ = results(device, case, weights)

    def refusing(queue, to, source, **values):
        if "src_offset" in values and not refused:  # the number of pairs
            refused.append(to)
            raise cl.MemoryError("clEnqueueReadBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")
        return copy(queue, to, source, **values)

    monkeypatch.setattr(cl, "enqueue_copy", refusing)
    banded_image, banded_sums, frame = results(device, case, weights)
    assert refused
    assert len(frame.bands) == 2
    np.testing.assert_array_equal(banded_image, image)
    np.testing.assert_array_equal(banded_sums, pixel_sums)


@on_one_setting
def test_memory_below_one_row_of_tiles_is_refused(device, rng):
    small = limited(device, 300 * 64)
    with pytest.raises(MemoryLimitError):
        results(small, random_case(rng, 301, 60, 70), 0.0)


@on_devices(
    "counts, sort",
    each_once([[2**31, 2**31, 5], [2**31, 5, 2**31], [MAX_PAIRS + 1], [2**24] * 300], ["radix", "bitonic"]),
)
def test_pair_count_beyond_32_bits_is_refused(device, sort, counts):
    counts = np.array(counts, np.uint32)
    nothing = np.zeros_like(counts)
    footprints = Footprints(device.upload(nothing), device.upload(counts), *map(device.upload, (nothing, nothing)))
    with pytest.raises(TooManyPairs):
        Tiler(device, Workspace(device), sort).build(
            device.zeros((len(counts), 16)), footprints, Band(4, 4, 0, 4), len(counts), MAX_PAIRS
        )


@on_one_setting
def test_frame_with_more_pairs_than_32_bits_renders_in_bands(device, rng, monkeypatch):
    """Each Gaussian of a band of several rows stands for many: the counts, which nothing but their sum reads."""
    case = random_case(rng, 300, 60, 70)
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, _ = results(device, case, weights)
    build = Tiler.build

    def crowded(tiler, splats, footprints, band, count, limit, defines=None):
        if band.row_end - band.row_begin > 1:
            footprints = replace(footprints, tile_count=device.upload(np.full(count, 2**32 // count + 1, np.uint32)))
        return build(tiler, splats, footprints, band, count, limit, defines)

    monkeypatch.setattr(Tiler, "build", crowded)
    banded_image, banded_sums, banded = results(device, case, weights)
    assert len(banded.bands) == banded.camera.tiles_y
    np.testing.assert_array_equal(banded_image, image)
    np.testing.assert_array_equal(banded_sums, pixel_sums)


@on_one_setting
def test_row_of_tiles_with_too_many_pairs_is_refused(device, rng, monkeypatch):
    monkeypatch.setattr("clsplat.render.rasterizer.MAX_PAIRS", 50)
    case = random_case(rng, 300, 60, 70)
    with pytest.raises(MemoryLimitError, match=r"60x70 px .*more than 50 .*; use smaller images, or fewer"):
        results(device, case, 0.0)


@on_one_setting
def test_uploads_keep_the_order_of_commands(device, rng):
    """Each launch reads the values that were uploaded before it, although all uploads share an array."""
    workspace, copy = Workspace(device), device.program("peak.cl").peak_copy
    items = copy.group[0]
    count = items * max(4, int(device.tuning["LANES"]))
    values = [rng.integers(0, 100, count).astype(np.float32) for _ in range(20)]
    results = [device.zeros(count) for _ in values]
    for expected, result in zip(values, results, strict=True):
        array = workspace.upload("values", expected)
        copy(items=items, values=array, copied=result)
    for expected, result in zip(values, results, strict=True):
        np.testing.assert_array_equal(result.get(), expected)
