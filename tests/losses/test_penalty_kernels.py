"""penalty.cl against the reference, and the reference against finite differences."""

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.gaussians.gaussians import INTERVAL2
from clsplat.gaussians.structs import GaussianGradients
from clsplat.losses.base import LossValue, PenaltyInputs
from clsplat.losses.penalties import Anisotropy, CovarianceTrace, MeanOpacity, MeanScale, MinScale
from clsplat.methods.natural_selection import OpacityPressure
from clsplat.render.workspace import Workspace
from tests.support.devices import on_devices, on_one_setting

COUNTS = (16, 64, 200)  # others are in the check of penalties
EXTENT = 2.5


def inputs_of(device, rng, count: int) -> tuple[PenaltyInputs, np.ndarray]:
    """Gaussians of many sizes and forms, with gradients that are not zero to begin with."""
    case = random_case(rng, count)
    case.parameters["log_scales"][:] = rng.normal(-2, 1.5, (count, 3))
    gaussians = case.model(device).gaussians
    gradients = GaussianGradients(gaussians)
    for name in ("log_scales", "logit_opacity"):
        planes = np.zeros((gaussians.tables[name].components, gaussians.capacity), np.float32)
        planes[:, :count] = 0.25
        gradients[name].set(planes)
    inputs = PenaltyInputs(Workspace(device), gaussians, gradients, EXTENT, step=1)
    return inputs, case.parameters["log_scales"].astype(np.float64)


def check(
    inputs: PenaltyInputs, actual: LossValue, value: float, gradient: np.ndarray, parameter: str = "log_scales"
) -> None:
    assert actual.value() == pytest.approx(value, rel=1e-5, abs=1e-12)
    planes, count = inputs.gradients[parameter].get(), inputs.gaussians.count
    added = planes[:, :count].T.astype(np.float64) - 0.25
    np.testing.assert_allclose(added, gradient, rtol=1e-4, atol=1e-6 * max(1, np.abs(gradient).max()))
    assert (planes[:, count:] == 0).all()


@on_devices("count", COUNTS)
def test_covariance_trace(device, rng, count):
    inputs, log_scales = inputs_of(device, rng, count)
    result = CovarianceTrace(weight=3.0, above=0.02).add(inputs)
    value, gradient = ref.covariance_trace(log_scales, 0.02 * EXTENT**2, EXTENT)
    assert count < 16 or 0 < np.count_nonzero(gradient) < gradient.size
    check(inputs, result, 3 * value, 3 * gradient)


@on_devices("count", COUNTS)
def test_covariance_trace_in_pixels(device, rng, count):
    """τ = 3 (pixels · interval)², each Gaussian's own."""
    inputs, log_scales = inputs_of(device, rng, count)
    interval = rng.uniform(0.01, 0.05, count).astype(np.float32)
    inputs.gaussians.add(INTERVAL2, 1)
    inputs.gaussians.set(INTERVAL2, interval[:, None] ** 2)
    result = CovarianceTrace(weight=2.0, above=9.0, pixels=4.0).add(inputs)
    each = [ref.covariance_trace(log_scales[n : n + 1], 3 * (4.0 * interval[n]) ** 2, EXTENT) for n in range(count)]
    value, gradient = (sum(v for v, _ in each) / count, np.concatenate([g for _, g in each]) / count)
    assert count < 16 or 0 < np.count_nonzero(gradient) < gradient.size
    check(inputs, result, 2 * value, 2 * gradient)


@on_one_setting
def test_two_penalties_keep_separate_values(device, rng):
    inputs, log_scales = inputs_of(device, rng, 50)
    losses = [CovarianceTrace(above=above).add(inputs) for above in (0.02, 1e6)]
    value, _ = ref.covariance_trace(log_scales, 0.02 * EXTENT**2, EXTENT)
    assert [loss.value() for loss in losses] == [pytest.approx(value, rel=1e-5), 0]


@on_devices("count", COUNTS)
def test_anisotropy(device, rng, count):
    inputs, log_scales = inputs_of(device, rng, count)
    result = Anisotropy(weight=0.1, above=8.0).add(inputs)
    value, gradient = ref.anisotropy(log_scales, 8.0)
    assert count < 16 or 0 < np.count_nonzero(gradient) < gradient.size
    check(inputs, result, 0.1 * value, 0.1 * gradient)


@on_devices("count", COUNTS)
def test_mean_scale(device, rng, count):
    inputs, log_scales = inputs_of(device, rng, count)
    value, gradient = ref.mean_scale(log_scales, EXTENT)
    check(inputs, MeanScale(weight=3.0).add(inputs), 3 * value, 3 * gradient)


@on_devices("count", COUNTS)
def test_min_scale(device, rng, count):
    """Of equal scales, as Gaussians have at first, each gets the gradient."""
    inputs, log_scales = inputs_of(device, rng, count)
    log_scales[1] = log_scales[1, 0]
    inputs.gaussians.set("log_scales", log_scales)
    value, gradient = ref.min_scale(log_scales, EXTENT)
    check(inputs, MinScale(weight=3.0).add(inputs), 3 * value, 3 * gradient)


@on_devices("count", COUNTS)
def test_opacity_pressure_acts_above_its_floor_and_number(device, rng, count):
    inputs, _ = inputs_of(device, rng, count)
    logits = rng.normal(0, 3, (count, 1))
    inputs.gaussians.set("logit_opacity", logits)
    value, gradient = ref.opacity_pressure(np.float32(logits).astype(np.float64), -1.0)
    check(inputs, OpacityPressure(weight=2.0, floor=-1.0).add(inputs), 2 * value, 2 * gradient, "logit_opacity")
    assert OpacityPressure(weight=2.0, gaussians=count).add(inputs).value() == 0


@on_devices("count", COUNTS)
def test_mean_opacity(device, rng, count):
    inputs, _ = inputs_of(device, rng, count)
    logits = rng.choice([-90.0, -6.0, 0.0, 3.0, 90.0], (count, 1)) + rng.normal(0, 1, (count, 1))
    inputs.gaussians.set("logit_opacity", logits)
    value, gradient = ref.mean_opacity(np.float32(logits).astype(np.float64))
    check(inputs, MeanOpacity(weight=3.0).add(inputs), 3 * value, 3 * gradient, "logit_opacity")


@pytest.mark.parametrize(
    "penalty",
    [
        lambda x: ref.covariance_trace(x, 0.1, EXTENT),
        lambda x: ref.anisotropy(x, 5.0),
        lambda x: ref.mean_scale(x, EXTENT),
        lambda x: ref.min_scale(x, EXTENT),
        ref.mean_opacity,
        lambda x: ref.opacity_pressure(x, -1.0),
    ],
)
def test_oracle_against_finite_differences(rng, penalty):
    log_scales, step = rng.normal(-1, 1, (30, 3)), 1e-6
    _, gradient = penalty(log_scales)
    for n, axis in np.ndindex(log_scales.shape):
        change = np.zeros_like(log_scales)
        change[n, axis] = step
        slope = (penalty(log_scales + change)[0] - penalty(log_scales - change)[0]) / (2 * step)
        assert slope == pytest.approx(gradient[n, axis], rel=1e-6, abs=1e-9)


def test_nan_affects_only_its_gaussian(device, rng):
    inputs, log_scales = inputs_of(device, rng, 40)
    log_scales[5] = np.nan
    inputs.gaussians.set("log_scales", log_scales)
    CovarianceTrace(above=0.02).add(inputs)
    planes = inputs.gradients["log_scales"].get()[:, :40]
    assert np.isfinite(np.delete(planes, 5, axis=1)).all()
