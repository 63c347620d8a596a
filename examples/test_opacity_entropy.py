"""Compare the kernel of opacity_entropy.py with NumPy in float64: `pytest examples/test_opacity_entropy.py`."""

from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.plugin import GaussianGradients, Gaussians, Penalty, PenaltyInputs, Workspace, variants

clsplat.load_plugin(Path(__file__).with_name("opacity_entropy.py"))


def mean_entropy(logits):
    """Return the mean entropy of the opacities, and its derivative with respect to each logit, in float64."""
    opacity = 1 / (1 + np.exp(-logits))
    entropy = -opacity * np.log(opacity) - (1 - opacity) * np.log(1 - opacity)
    return entropy.mean(), -logits * opacity * (1 - opacity) / len(logits)


@pytest.mark.parametrize("schedule", ["wide", "simt"])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 64, 65])  # around vector and group sizes
def test_the_kernel_adds_the_gradient_and_returns_the_value(schedule, count):
    logits = np.random.default_rng(count).normal(0, 2, (count, 1)).astype(np.float32)
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": 0}
    tables = {name: np.ones((count, width), np.float32) for name, width in widths.items()}
    gaussians = Gaussians(clsplat.Device(schedule=schedule), {**tables, "logit_opacity": logits})
    gradients = GaussianGradients(gaussians)
    gradients["logit_opacity"].fill(0.25)  # the gradient of other losses
    inputs = PenaltyInputs(Workspace(gaussians.device), gaussians, gradients, extent=1.0, step=1)
    loss = variants(Penalty)["opacity_entropy"](weight=3.0).add(inputs)
    value, derivative = mean_entropy(logits.astype(np.float64))
    assert loss.value() == pytest.approx(3 * value, rel=1e-5)
    planes = gradients["logit_opacity"].get()
    np.testing.assert_allclose(planes[0, :count] - 0.25, 3 * derivative[:, 0], rtol=1e-4, atol=1e-6)
    assert (planes[0, count:] == 0.25).all()  # padding rows stay unchanged


def test_the_derivative_is_that_of_finite_differences():
    logits = np.random.default_rng(0).normal(0, 2, (5, 1))
    for i in range(5):
        step = 1e-6 * (np.arange(5) == i)[:, None]
        slope = (mean_entropy(logits + step)[0] - mean_entropy(logits - step)[0]) / 2e-6
        assert mean_entropy(logits)[1][i, 0] == pytest.approx(slope, abs=1e-8)
