"""adam.cl against the reference, and average.cl with its stages against float64 averages."""

import numpy as np
import pytest

from clsplat.conformance.checks.projection import undrawable_case
from clsplat.conformance.checks.training import check_average, check_rows, check_step, move_every_fifth_behind
from clsplat.conformance.scenes import Case, add_world_filter, random_case
from clsplat.density.statistics import SplatStats
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.structs import GaussianGradients, moment_tables
from clsplat.losses.base import ViewGradients
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.training import adam as average
from clsplat.training.adam import Adam, Rates, Rows
from tests.support.deviations import assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting, product


def frame_of(device: Device, case: Case, model: DeviceModel) -> Frame:
    return Rasterizer(device, "radix").forward(model, case.device_camera(device), device.zeros(3))


def updated(
    device: Device, case: Case, rows: Rows, from_memory: bool = False, vectors: int = 0
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """All tables before and after an update with moments that are not zero; the gradient of the image is 1."""
    opened = Device(device.info, device.schedule)
    opened.tuning.update(device.tuning, **({"VECTORS": vectors} if vectors else {}))
    rasterizer, model = Rasterizer(opened, "radix"), case.model(opened)
    gaussians, adam, camera, rng = model.gaussians, Adam(model.gaussians), case.device_camera(opened), np.random
    for name in PARAMETERS:
        for number, table in enumerate(moment_tables(name)):
            numbers = rng.default_rng(number).uniform(0.5, 2, (gaussians.count, gaussians.tables[name].components))
            gaussians.set(table, numbers)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    frame = rasterizer.forward(model, camera, opened.zeros(3))
    ones = np.zeros((3, camera.rows, camera.stride), np.float32)
    ones[:, : camera.height, : camera.width] = 1
    pixel_sums = rasterizer.pixel_sums(model, frame, opened.upload(ones))
    if from_memory:
        gradients = rasterizer.gradients(model, frame, pixel_sums)
        for array in gradients.arrays.values():  # as penalties may
            array.fill(0.5)
        adam.step(model, frame, gradients, Rates().at(3, extent=2.0), rows=rows)
    else:
        adam.update(model, frame, pixel_sums, Rates().at(3, extent=2.0), rows)
    return before, {name: gaussians.get(name) for name in gaussians.tables}


def changed_rows(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> np.ndarray:
    """Rows whose bits are others, which must be so in all tables or in none."""
    changed = [(before[n].view(np.uint32) != after[n].view(np.uint32)).any(axis=1) for n in before]
    moved = [rows for name, rows in zip(before, changed, strict=True) if name != "filter_variance"]
    assert all((rows == moved[0]).all() for rows in moved)
    return moved[0]


def touches_a_pixel(case: Case) -> np.ndarray:
    """Whether a Gaussian is not fainter than 1/255 at the center of any pixel, by the reference."""
    truth, (width, height) = case.project(), case.size
    centers = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2) + 0.5
    dx, dy = np.moveaxis(truth.mean2d - centers, -1, 0)
    xx, xy, yy = truth.conic.T
    alpha = truth.opacity * np.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
    return truth.visible & (alpha >= 1 / 255).any(axis=0)


@on_devices("count", [16, 64, 150])
def test_steps(device, rng, count):
    assert_within_bounds(check_step(device, rng, count))


@on_devices(
    "degree, sh_rest, rows, count",
    each_once(
        [
            (0, 1e-4, "all"),
            (2, 1e-4, "all"),
            (3, 1e-4, "all"),
            (3, {"every": 2, "value": 1e-4}, "all"),
            (3, 1e-4, "seen"),
            (3, 1e-4, "seen"),
        ],
        [64, 17, 150, 1],
    ),
)
def test_fused_update_equals_stored_gradients(device, rng, count, degree, sh_rest, rows):
    """update_gaussians against the separate kernels, bit for bit, moments, screen gradients, and statistics too."""
    case = move_every_fifth_behind(add_world_filter(random_case(rng, count, degree=degree, compensate=1.0), rng))
    weights = rng.normal(size=(3, 32, 48)).astype(np.float32)
    weights[:, 30:], weights[:, :, 40:] = 0, 0
    tables, statistic = [], "screen_grad_abs" if degree == 2 else "screen_grad"
    for fused in (False, True):
        rasterizer, model = Rasterizer(device, "radix"), case.model(device)
        camera = case.device_camera(device)
        adam, stats = Adam(model.gaussians), SplatStats(model.gaussians, [statistic, "screen_radius"])
        for step in (2, 3, 4):
            rates = Rates(sh_rest=sh_rest).at(step, extent=2.0)
            frame = rasterizer.forward(model, camera, device.zeros(3))
            weight_planes = device.upload(weights[:, : camera.rows, : camera.stride].copy())
            sums = rasterizer.backward(model, frame, weight_planes, stats.pixel_sums)
            if fused:
                inputs = model, frame, sums.array if step == 3 else sums, rates, rows
                grad_mean2d = adam.update(*inputs, stats.update_arguments())
            else:
                gradients = rasterizer.gradients(model, frame, sums.array)
                adam.step(model, frame, gradients, rates, rows=rows)
                grad_mean2d = gradients.mean2d
            stats.add(ViewGradients(frame, None, [], sums), grad_mean2d, after_update=fused)
        mean2d = grad_mean2d.get()[:, :count]
        tables.append({"mean2d": mean2d, **{name: model.gaussians.get(name) for name in model.gaussians.tables}})
    assert count == 1 or (tables[0]["means"] != case.parameters["means"]).any()
    for name, table in tables[0].items():
        np.testing.assert_array_equal(tables[1][name], table, err_msg=name)


@on_one_setting
def test_bands_above_the_active_degree_do_not_change(device, rng):
    case = random_case(rng, 20, degree=1)
    model = case.model(device)
    adam, gradients = Adam(model.gaussians), GaussianGradients(model.gaussians)
    gradients["sh_rest"].fill(1)
    adam.step(model, frame_of(device, case, model), gradients, Rates().at(1, 1.0))
    moved = model.gaussians.get("sh_rest") != case.parameters["sh_rest"]
    assert moved[:, :9].all()
    assert not moved[:, 9:].any()


@on_devices("count", [1, 17, 150])
def test_bands_with_rate_0_keep_values_and_moments(device, rng, count):
    """Their number of updates too, so that the next one is corrected as it must be; all else is as with a rate."""
    case = random_case(rng, count)
    tables, updates = [], []
    for rate in (1e-4, 0.0):
        rasterizer, model = Rasterizer(device, "radix"), case.model(device)
        camera = case.device_camera(device)
        adam = Adam(model.gaussians)
        frame = rasterizer.forward(model, camera, device.zeros(3))
        ones = device.upload(np.ones((3, camera.rows, camera.stride), np.float32))
        adam.update(model, frame, rasterizer.pixel_sums(model, frame, ones), Rates(sh_rest=rate).at(3, extent=2.0))
        tables.append({name: model.gaussians.get(name) for name in model.gaussians.tables})
        updates.append(adam.updates)
    np.testing.assert_array_equal(tables[1]["sh_rest"], case.parameters["sh_rest"])
    assert (updates[0]["sh_rest"], updates[1]["sh_rest"]) == (1, 0)
    for name, table in tables[1].items():
        if name in moment_tables("sh_rest"):
            assert not table.any(), name
            assert tables[0][name].any(), name
        elif name != "sh_rest":
            np.testing.assert_array_equal(table, tables[0][name], err_msg=name)


@on_one_setting
def test_omitted_parameters_do_not_change(device, rng):
    case = random_case(rng, 20)
    model = case.model(device)
    adam, gradients = Adam(model.gaussians), GaussianGradients(model.gaussians)
    for array in gradients.arrays.values():
        array.fill(1)
    adam.step(model, frame_of(device, case, model), gradients, Rates().at(1, 1.0), frozen={"means"})
    np.testing.assert_array_equal(model.gaussians.get("means"), case.parameters["means"])
    assert adam.updates["means"] == 0
    assert adam.updates["quats"] == 1


def test_rate_of_the_means_decays():
    rates = Rates()
    assert rates.at(0, 1.0)["means"] == pytest.approx(1.6e-4)
    assert rates.at(15_000, 1.0)["means"] == pytest.approx(1.6e-5)
    assert rates.at(30_000, 2.0)["means"] == pytest.approx(3.2e-6)
    assert rates.at(90_000, 2.0)["means"] == pytest.approx(3.2e-6)


# ---- rows that the view sees


@on_devices("count", [0, 16, 63, 64, 150])
def test_visible_rows(device, rng, count):
    assert_within_bounds(
        check_rows(device, rng, move_every_fifth_behind(random_case(rng, count)), f"{count} Gaussians")
    )


@on_devices(
    "seen, from_memory",
    each_once(product([(), (0,), (16,), (63, 64), (149,), range(16, 32), range(150)]), [False, True]),
)
def test_only_visible_rows_change(device, rng, seen, from_memory):
    """Alone, at the edges of vectors and blocks, a whole vector; gradients of penalties change nothing of it."""
    case = random_case(rng, 150)
    case.parameters["log_scales"] += 1
    culled = np.setdiff1d(np.arange(150), list(seen))
    case.parameters["means"][:] = case.parameters["means"].mean(axis=0)
    case.parameters["means"][culled] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    case.parameters["logit_opacity"][:] = 1
    before, after = updated(device, case, "seen", from_memory)
    np.testing.assert_array_equal(np.flatnonzero(changed_rows(before, after)), list(seen))
    _, everywhere = updated(device, case, "all", from_memory)
    assert changed_rows(before, everywhere).all()
    for name, table in after.items():
        np.testing.assert_array_equal(table[list(seen)], everywhere[name][list(seen)], err_msg=name)


@on_one_setting
def test_gaussian_with_a_pixel_is_visible(device, rng):
    """By the slow formula; of those without a pixel, the few whose extent reaches the photograph change too."""
    case = random_case(rng, 300)
    case.parameters["means"][::2] *= [3, 3, 1]
    touches, changed = touches_a_pixel(case), changed_rows(*updated(device, case, "seen"))
    assert touches.sum() > 50
    assert (~touches).sum() > 50
    assert not (touches & ~changed).any()
    assert (changed & ~touches).sum() < 0.1 * (~touches).sum()


@on_devices("from_memory", [False, True])
def test_degenerate_rows_keep_their_bits(device, rng, from_memory):
    """Behind the camera, huge, faint or not numbers."""
    case = undrawable_case(rng)
    undrawn = case.model(device)
    visible = frame_of(device, case, undrawn).depth_key.get()[:40] != 0xFFFFFFFF
    before, after = updated(device, case, "seen", from_memory)
    np.testing.assert_array_equal(changed_rows(before, after), visible)
    assert not visible[[0, 1, 2, 3, 4, 5, 7, 8]].any()
    assert visible.sum() > 15


@on_devices("vectors, rows", each_once([1, 2, 8, 1, 2, 8], ["all", "seen"]))
def test_bits_do_not_depend_on_the_vectors_of_an_item(device, rng, vectors, rows):
    case = move_every_fifth_behind(random_case(rng, 150))
    case.parameters["means"][40:90] -= 20 * case.view.world_to_camera[2, :3]  # whole vectors
    expected = updated(device, case, rows)[1]
    for name, table in updated(device, case, rows, vectors=vectors)[1].items():
        np.testing.assert_array_equal(table, expected[name], err_msg=name)


@on_devices("count", [16, 64, 150])
def test_average_of_three_steps(device, rng, count):
    assert_within_bounds(check_average(device, rng, count))


@on_one_setting
def test_rows_without_an_average_keep_their_values(device, rng):
    gaussians = random_case(rng, 20).model(device).gaussians
    before = {name: gaussians.get(name) for name in gaussians.tables}
    average.attach_average(gaussians)
    average.apply_average(gaussians)
    assert gaussians.tables.keys() == before.keys()
    for name in PARAMETERS:
        np.testing.assert_array_equal(gaussians.get(name), before[name])


@on_one_setting
def test_empty_model(device, rng):
    gaussians = random_case(rng, 0).model(device).gaussians
    average.attach_average(gaussians)
    average.add_to_average(gaussians)
    average.apply_average(gaussians)
    assert gaussians.count == 0


@on_one_setting
def test_average_of_equal_values_is_the_value(device, rng):
    """To the bit, as a table of the parameters that no step changes."""
    gaussians = random_case(rng, 65).model(device).gaussians
    before = {name: gaussians.get(name) for name in PARAMETERS}
    average.attach_average(gaussians)
    for _ in range(7):
        average.add_to_average(gaussians)
    average.apply_average(gaussians)
    for name in PARAMETERS:
        np.testing.assert_array_equal(gaussians.get(name), before[name])


def test_nan_stays_in_its_row(device, rng):
    gaussians = random_case(rng, 17).model(device).gaussians
    means = gaussians.get("means")
    means[3] = np.nan
    gaussians.set("means", means)
    average.attach_average(gaussians)
    average.add_to_average(gaussians)
    average.apply_average(gaussians)
    result = gaussians.get("means")
    assert np.isnan(result[3]).all()
    assert np.isfinite(np.delete(result, 3, axis=0)).all()
