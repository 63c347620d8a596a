"""deferred.cl against the reference, and against immediate updates."""

import numpy as np
import pytest

from clsplat.conformance.checks.training import check_deferred, move_every_fifth_behind, random_visible_rows, train
from clsplat.conformance.scenes import Case, add_world_filter, random_case
from clsplat.core.errors import ConfigError
from clsplat.gaussians.deferred import DeferredHarmonics
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.structs import GaussianGradients
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates, Rows
from tests.support.deviations import assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting, product


def hide(model: DeviceModel, case: Case, step: int) -> None:
    """Put other Gaussians behind the camera at each step: two thirds, nearly all, or all."""
    means = case.parameters["means"].copy()
    hidden = np.random.default_rng(step).random(len(means)) < (1.0, 0.7, 0.98)[step % 3]
    means[hidden] -= 20 * case.view.world_to_camera[2, :3]
    model.gaussians.set("means", means)


def bits_after(
    device: Device,
    case: Case,
    rows: Rows,
    sh_rest: object = 1e-4,
    from_memory: bool = False,
    edit=None,
    on_host: bool = False,
):
    """All tables, as whole numbers, after nine steps of a model of which each step sees others."""
    rasterizer, model = Rasterizer(device, "radix"), case.model(device)
    if on_host:
        model.gaussians.move_to_host()
    camera, adam = case.device_camera(device), Adam(model.gaussians)
    weights = np.random.default_rng(5).normal(size=(3, camera.rows, camera.stride)).astype(np.float32)
    for step in range(1, 10):
        hide(model, case, step)
        rates = Rates(sh_rest=sh_rest).at(step, extent=2.0)
        frame = rasterizer.forward(model, camera, device.zeros(3))
        pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(weights))
        if from_memory:
            adam.step(model, frame, rasterizer.gradients(model, frame, pixel_sums), rates, rows=rows)
        else:
            adam.update(model, frame, pixel_sums, rates, rows)
        if edit:
            edit(model, adam, step)
    return {name: model.gaussians.get(name).view(np.uint32) for name in model.gaussians.tables}


def assert_equal(device: Device, case: Case, **settings: object) -> None:
    at_once = bits_after(device, case, "all", **settings)
    for name, table in bits_after(device, case, "deferred", **settings).items():
        np.testing.assert_array_equal(table, at_once[name], err_msg=name)


@on_devices("count", [0, 16, 64])
def test_deferred_updates(device, rng, count):
    assert_within_bounds(check_deferred(device, rng, count))


@on_devices(
    "count, degree, sh_rest, from_memory",
    each_once(
        [(1, 3, 1e-4), (150, 0, 1e-4), (150, 2, 1e-4), (300, 3, {"every": 2, "value": 1e-4}), (300, 3, 1e-4)],
        [False, True],
    ),
)
def test_deferred_updates_give_the_bits_of_immediate_ones(device, rng, count, degree, sh_rest, from_memory):
    case = move_every_fifth_behind(add_world_filter(random_case(rng, count, degree=degree), rng))
    assert_equal(device, case, sh_rest=sh_rest, from_memory=from_memory)


def raise_degree(model: DeviceModel, adam: Adam, step: int) -> None:
    model.degree = min(3, step // 3)


def move_rows(model: DeviceModel, adam: Adam, step: int) -> None:
    """Double the rows: the tables grow beyond their capacity."""
    if step in (4, 6):
        count = model.gaussians.count
        source = model.gaussians.device.upload(np.arange(2 * count, dtype=np.uint32) % count)
        fresh = model.gaussians.device.upload((np.arange(2 * count) >= count).astype(np.uint32))
        model.gaussians.rearrange(source, fresh, 2 * count)
        model.gaussians.rearrange(source, fresh, count)


def write_rows(model: DeviceModel, adam: Adam, step: int) -> None:
    rows = np.arange(0, model.gaussians.count, 7)
    if step == 4:
        model.gaussians.set_rows("sh_rest", rows, np.full((len(rows), 45), 0.5, np.float32))
    if step == 5:
        model.gaussians.zero_rows(["adam/sh_rest/moment1"], rows)
    if step == 7:
        adam.reset_moments("sh_rest")


def drop_bands(model: DeviceModel, adam: Adam, step: int) -> None:
    if step == 5:
        model.gaussians.lower_sh_degree(1)
        model.degree = 1


@on_devices("edit", [raise_degree, move_rows, write_rows, drop_bands])
def test_edits_apply_deferred_updates_first(device, rng, edit):
    assert_equal(device, move_every_fifth_behind(random_case(rng, 100)), edit=edit)


def test_longest_list_does_not_change_the_bits(device, rng, monkeypatch):
    case = random_case(rng, 100)
    seen = [random_visible_rows(rng, 100) for _ in range(7)]
    gradients = [rng.normal(size=(100, 45)).astype(np.float32) * mask[:, None] for mask in seen]
    results = []
    for longest in (1, 2, 7, 32):
        monkeypatch.setattr("clsplat.conformance.checks.training.MAX_DEFERRED", longest)
        results.append(train(device, case.model(device), seen, gradients, "deferred"))
    for name in DeferredHarmonics.names:
        for tables in results[1:]:
            np.testing.assert_array_equal(tables[name].view(np.uint32), results[0][name].view(np.uint32))


@on_one_setting
def test_updates_of_invisible_rows_are_deferred(device, rng):
    """Their harmonics lie as they were, and whoever asks for them gets what they are."""
    case = random_case(rng, 150)
    model, visible = case.model(device), np.arange(150) < 16
    gradients = np.full((150, 45), 2, np.float32) * visible[:, None]
    adam, first = Adam(model.gaussians), np.ones((150, 45), np.float32)
    model.gaussians.set("adam/sh_rest/moment1", first)
    frame = Rasterizer(device, "radix").forward(model, case.device_camera(device), device.zeros(3))
    keys = np.where(np.arange(model.gaussians.capacity) < 16, 7, 0xFFFFFFFF).astype(np.uint32)
    frame.depth_key.set(keys)
    of_loss = GaussianGradients(model.gaussians)
    planes = np.zeros(of_loss["sh_rest"].shape, np.float32)
    planes[:, :150] = gradients.T
    of_loss["sh_rest"].set(planes)
    adam.step(model, frame, of_loss, Rates().at(1, 2.0), rows="deferred")
    lying = model.gaussians.deferred.array("adam/sh_rest/moment1").get()[:, :150].T
    np.testing.assert_array_equal((lying != first).any(axis=1), visible)
    assert (model.gaussians.get("adam/sh_rest/moment1") != first).all()


@on_one_setting
def test_penalty_on_deferred_harmonics_is_refused(device, rng):
    gradients = GaussianGradients(random_case(rng, 5).model(device).gaussians)
    assert gradients.without_deferred()["means"] is gradients["means"]
    with pytest.raises(ConfigError, match="`update: all` with"):
        gradients.without_deferred()["sh_rest"]


@on_devices(
    "count, degree, rows, from_memory",
    each_once([(0, 3), (1, 3), (17, 2), (64, 0), (65, 3), (300, 3)], product(["all", "seen"], [False, True])),
)
def test_bits_do_not_depend_on_the_location_of_harmonics(device, rng, count, degree, rows, from_memory):
    case = move_every_fifth_behind(add_world_filter(random_case(rng, count, degree=degree), rng))
    on_device = bits_after(device, case, rows, from_memory=from_memory)
    on_host = bits_after(device, case, rows, from_memory=from_memory, on_host=True)
    for name, table in on_device.items():
        np.testing.assert_array_equal(on_host[name], table, err_msg=name)


@on_devices("edit", [raise_degree, move_rows, write_rows, drop_bands])
def test_edits_see_rows_on_the_host(device, rng, edit):
    case = move_every_fifth_behind(random_case(rng, 100))
    on_device = bits_after(device, case, "all", edit=edit)
    for name, table in bits_after(device, case, "all", edit=edit, on_host=True).items():
        np.testing.assert_array_equal(table, on_device[name], err_msg=name)


@on_one_setting
def test_error_explains_that_rows_are_on_the_host(device, rng):
    model = random_case(rng, 20).model(device)
    before = model.gaussians.get("sh_rest")
    model.gaussians.move_to_host()
    model.gaussians.move_to_host()
    np.testing.assert_array_equal(model.gaussians.get("sh_rest"), before)
    with pytest.raises(ConfigError, match="is in host memory"):
        model.gaussians["sh_rest"]
    before[3, 7] = np.nan
    assert model.gaussians.find_nonfinite() == []
    model.gaussians.set("sh_rest", before)
    assert model.gaussians.find_nonfinite() == ["sh_rest"]
