"""adam.cl against the oracle."""

import numpy as np
import pytest

from clsplat.conformance.checks.update import step_figures
from clsplat.conformance.scenes import random_case, with_world_filter
from clsplat.gaussians.tables import Gradients, moment_tables
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates
from tests.kernels.figures import hold


@pytest.mark.parametrize("count", [1, 15, 16, 17, 64, 65])
def test_steps(device, rng, count):
    hold(step_figures(device, rng, count))


@pytest.mark.parametrize("count", [1, 17, 64, 150])
@pytest.mark.parametrize(("degree", "sh_rest"), [(0, 1e-4), (2, 1e-4), (3, 1e-4), (3, {"every": 2, "value": 1e-4})])
def test_update_on_the_way_equals_gradients_in_memory(device, rng, count, degree, sh_rest):
    """update_gaussians against project_backward and adam_step, bit for bit, moments and screen gradients too."""
    case = with_world_filter(random_case(rng, count, degree=degree, compensate=1.0), rng)
    case.parameters["means"][1::5] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    weights = rng.normal(size=(3, 32, 48)).astype(np.float32)
    weights[:, 30:], weights[:, :, 40:] = 0, 0
    tables = []
    for fused in (False, True):
        rasterizer, model = Rasterizer(device, "radix"), case.model(device)
        camera = case.device_camera(device)
        adam = Adam(model.gaussians)
        for step in (2, 3, 4):
            rates = Rates(sh_rest=sh_rest).at(step, extent=2.0)
            frame = rasterizer.forward(model, camera, device.zeros(3))
            pixel_sums = rasterizer.pixel_sums(
                model, frame, device.upload(weights[:, : camera.rows, : camera.stride].copy())
            )
            if fused:
                grad_mean2d = adam.update(model, frame, pixel_sums, rates)
            else:
                gradients = rasterizer.gradients(model, frame, pixel_sums)
                adam.step(model, gradients, rates)
                grad_mean2d = gradients.mean2d
        mean2d = grad_mean2d.get()[:, :count]
        tables.append({"mean2d": mean2d, **{name: model.gaussians.get(name) for name in model.gaussians.tables}})
    assert count == 1 or (tables[0]["means"] != case.parameters["means"]).any()
    for name, table in tables[0].items():
        np.testing.assert_array_equal(tables[1][name], table, err_msg=name)


def test_bands_above_the_active_degree_stay(device, rng):
    case = random_case(rng, 20, degree=1)
    model = case.model(device)
    adam, gradients = Adam(model.gaussians), Gradients(model.gaussians)
    gradients["sh_rest"].fill(1)
    adam.step(model, gradients, Rates().at(1, 1.0))
    moved = model.gaussians.get("sh_rest") != case.parameters["sh_rest"]
    assert moved[:, :9].all()
    assert not moved[:, 9:].any()


@pytest.mark.parametrize("count", [1, 17, 150])
def test_bands_whose_rate_is_0_stay_with_their_moments(device, rng, count):
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


def test_parameters_left_out_stay(device, rng):
    case = random_case(rng, 20)
    model = case.model(device)
    adam, gradients = Adam(model.gaussians), Gradients(model.gaussians)
    for array in gradients.arrays.values():
        array.fill(1)
    adam.step(model, gradients, Rates().at(1, 1.0), without={"means"})
    np.testing.assert_array_equal(model.gaussians.get("means"), case.parameters["means"])
    assert adam.updates["means"] == 0
    assert adam.updates["quats"] == 1


def test_rate_of_the_means_decays(device):
    rates = Rates()
    assert rates.at(0, 1.0)["means"] == pytest.approx(1.6e-4)
    assert rates.at(15_000, 1.0)["means"] == pytest.approx(1.6e-5)
    assert rates.at(30_000, 2.0)["means"] == pytest.approx(3.2e-6)
    assert rates.at(90_000, 2.0)["means"] == pytest.approx(3.2e-6)
