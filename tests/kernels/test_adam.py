"""adam.cl against the oracle."""

import numpy as np
import pytest

from clsplat.gaussians.model import PARAMETERS, Gradients
from clsplat.training.adam import Adam, Rates
from tests import reference_loss as ref_loss
from tests.scenes import random_case


@pytest.mark.parametrize("count", [1, 15, 16, 17, 64, 65])
def test_steps(device, rng, count):
    case = random_case(rng, count)
    model = case.model(device)
    gaussians = model.gaussians
    adam, rates = Adam(gaussians), Rates().at(3, extent=2.0)
    values = {name: case.parameters[name].astype(np.float64) for name in PARAMETERS}
    moments = {name: (np.zeros_like(v), np.zeros_like(v)) for name, v in values.items()}
    for step in range(1, 4):
        gradients = Gradients(gaussians)
        for name in PARAMETERS:
            gradient = (rng.normal(size=values[name].shape) * rng.choice([1e-7, 1e-3, 1], values[name].shape)).astype(
                np.float32
            )
            gradient[::3] = 0
            planes = np.zeros(gradients[name].shape, np.float32)
            planes[:, :count] = gradient.T
            gradients[name].set(planes)
            values[name], *moments[name] = ref_loss.adam_step(
                values[name], gradient.astype(np.float64), *moments[name], step, rates[name]
            )
        adam.step(model, gradients, rates)
    for name in PARAMETERS:
        moved = np.abs(values[name] - case.parameters[name]).max()
        np.testing.assert_allclose(gaussians.get(name), values[name], rtol=3e-7, atol=2e-5 * moved)
        np.testing.assert_allclose(
            gaussians.get(f"adam/{name}/moment1"),
            moments[name][0],
            rtol=1e-5,
            atol=1e-6 * np.abs(moments[name][0]).max(),
        )


def test_bands_above_the_active_degree_stay(device, rng):
    case = random_case(rng, 20, degree=1)
    model = case.model(device)
    adam, gradients = Adam(model.gaussians), Gradients(model.gaussians)
    gradients["sh_rest"].fill(1)
    adam.step(model, gradients, Rates().at(1, 1.0))
    moved = model.gaussians.get("sh_rest") != case.parameters["sh_rest"]
    assert moved[:, :9].all()
    assert not moved[:, 9:].any()


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
