"""Color corrections (colors.cl) against float64, and in a training step."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.checks.appearance import check_color
from clsplat.conformance.checks.images import make_camera, to_planes
from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.image import L1, L2, Dssim
from clsplat.photos.appearance import IDENTITY, ViewTable
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.exposure import Affine, Exposure, ExposureState, Gain, transform_colors
from clsplat.training.trainer import StepTrainer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices, on_one_setting, product

SMOOTH = (L2(),)
BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)
SIZES = ((1, 1), (2, 1), (15, 4), (16, 16), (17, 5), (33, 18), (127, 32), (129, 65), (257, 3))


@on_devices("width, height", SIZES)
def test_image_and_derivatives(device, rng, width, height):
    assert_within_bounds(check_color(device, rng, width, height))


@on_one_setting
def test_identity_only_clips_white(device, rng):
    image = rng.uniform(-0.5, 1.5, (3, 18, 33)).astype(np.float32)
    camera = make_camera(device, 33, 18)
    result = transform_colors(Workspace(device), camera, to_planes(device, camera, image), IDENTITY).get()
    assert (result[:, :18, :33] == np.minimum(image, 1)).all()


class Case:
    """A trainer of a random scene; its photograph is the second of two, which have colors of their own."""

    def __init__(self, device, rng, colors=None, losses=SMOOTH, share=None) -> None:
        case, self.scalars = random_case(rng, 40, 50, 36), {}
        model, pixels = case.model(device), rng.integers(0, 256, (3, 36, 50)).astype(np.uint8)
        mask = None if share is None else device.upload((rng.random((1, 36, 50)) < share).astype(np.uint8))
        camera = replace(case.device_camera(device), view_index=1)
        self.photograph = Photograph(camera, device.upload(pixels), mask)
        parts = Rasterizer(device), model, Adam(model.gaussians), SplatStats(model.gaussians, [])
        self.trainer = StepTrainer(*parts, device.upload(BACKGROUND), losses, Rates())
        if colors:
            state, gains = ExposureState(Exposure(model=colors), ("a", "b")), np.array([0.3, 0.1, -0.2])
            state.rate, state.scalars = 0.01, self.scalars
            state.start_from({"a": -gains, "b": gains})
            self.trainer.modules = [state]

    def loss(self, key: str, change: float) -> float:
        """The loss with one number changed."""
        self.trainer.modules[0].scalars = {**self.scalars, key: self.scalars[key] + change}
        return self.trainer.compare(self.photograph, 1).loss


@on_devices("colors, share", product([Gain(), Affine(weight=0.3)], [None, 0.7]))
def test_step_gradient_is_that_of_its_losses(device, rng, monkeypatch, colors, share):
    """By finite differences of the loss; l2 is smooth."""
    case, results = Case(device, rng, colors, share=share), []
    table, step = case.trainer.modules[0].table, 2e-3
    numeric = [(case.loss(key, step) - case.loss(key, -step)) / (2 * step) for key in table.keys("b")]
    case.trainer.modules[0].scalars = case.scalars
    monkeypatch.setattr(
        ViewTable, "update", lambda self, scalars, view, gradient, rate: results.append((view, gradient))
    )
    case.trainer.step(case.photograph, 1)
    ((view, gradient),) = results
    assert view == "b"
    assert gradient == pytest.approx(np.array(numeric), rel=0.02, abs=2e-4)


def gradients_of(device, rng, colors, losses) -> dict[str, np.ndarray]:
    """Of the parameters of the Gaussians, at one view."""
    trainer = (case := Case(device, rng, colors, losses)).trainer
    gaussians = trainer.model.gaussians
    for name in ("sh_base", "sh_rest"):  # no pixel is beyond white, where the image would be cut
        gaussians.set(name, gaussians.get(name) * np.float32(0.2))
    view = trainer.differentiate(case.photograph, 1)
    result = trainer.rasterizer.gradients(trainer.model, view.frame, view.pixel_sums)
    return {name: result[name].get() for name in ("means", "sh_base", "logit_opacity")}


@on_one_setting
def test_identity_parameters_leave_the_gradients(device, rng, monkeypatch):
    losses = L1(weight=0.8), Dssim(weight=0.2)
    monkeypatch.setattr(Gain, "from_gains", lambda self, gains: np.zeros(3))
    state = rng.bit_generator.state
    plain = gradients_of(device, rng, None, losses)
    rng.bit_generator.state = state
    gradients = gradients_of(device, rng, Gain(), losses)
    for name, expected in plain.items():
        assert np.linalg.norm(gradients[name] - expected) < 1e-4 * np.linalg.norm(expected), name


def test_mask_hides_pixels_regardless_of_their_colors(device, rng):
    """An offset makes black pixels bright."""
    case = Case(device, rng, Affine(), share=0.5)
    case.scalars.update({key: 0.2 for key in case.trainer.modules[0].table.keys("b") if key.endswith("1")})
    image = case.trainer.compare(case.photograph, 1).comparison.image.get()[:, :36, :50]
    hidden = ~case.photograph.unmasked_pixels()
    assert (image[:, hidden] == 0).all()
    assert (image[:, ~hidden] > 0.1).all()
