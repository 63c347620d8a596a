"""The environment map (sky.cl) against float64, and in a training step."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.checks.sky import check_cover, check_sky
from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.gaussians.sky import Sky
from clsplat.losses.image import L2
from clsplat.photos.photographs import Photograph
from clsplat.render.backdrops import EnvironmentMap
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.sky import Skies
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.sky import LearnedSky
from clsplat.training.trainer import StepTrainer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices, on_one_setting

SIZES = ((1, 1, 8), (2, 1, 9), (15, 4, 8), (16, 16, 16), (17, 5, 33), (33, 18, 8), (127, 9, 21), (129, 17, 64))


@on_devices("width, height, side", SIZES)
def test_picture_and_derivatives(device, rng, width, height, side):
    assert_within_bounds(check_sky(device, rng, width, height, side))


@on_devices("width, height, side", SIZES)
def test_cover_of_the_sky(device, rng, width, height, side):
    assert_within_bounds(check_cover(device, rng, width, height, side))


class Scene:
    """A trainer of a random model before a random sky, and a photograph that shows the sky in most pixels."""

    def __init__(self, device, rng, settings, share=None) -> None:
        case = random_case(rng, 40, 50, 36)
        self.model, self.settings = case.model(device), settings
        sky = Sky(rng.random((settings.side**2, 3)).astype(np.float32)).upload(device)
        self.model.sky, camera = sky, case.device_camera(device)
        rasterizer, black = Rasterizer(device), device.zeros(3)
        bare = rasterizer.forward(replace(self.model, gaussians=self.model.gaussians), camera, black).image.get()
        pixels = np.clip(bare[:, :36, :50] + rng.normal(0, 0.2, (3, 36, 50)) * (rng.random((36, 50)) < 0.05), 0, 1)
        mask = None if share is None else device.upload((rng.random((1, 36, 50)) < share).astype(np.uint8))
        self.photograph = Photograph(camera, device.upload(np.rint(255 * pixels).astype(np.uint8)), mask)
        parts = rasterizer, self.model, Adam(self.model.gaussians), SplatStats(self.model.gaussians, [])
        self.trainer = StepTrainer(*parts, black, (L2(),), Rates(), modules=[LearnedSky(settings, sky)])
        sky.texels.set(np.clip(sky.texels.get() + rng.normal(0, 0.01, sky.texels.shape), 0, 1).astype(np.float32))

    def loss(self) -> float:
        return self.trainer.compare(self.photograph, 1).loss


def numeric(scene: Scene, array, place: tuple[int, int], step: float) -> float:
    """The derivative of the loss by one value of an array on the device."""
    before, losses = array.get(), []
    for sign in (1, -1):
        changed = before.copy()
        changed[place] += sign * step
        array.set(changed)
        losses.append(scene.loss())
    array.set(before)
    return (losses[0] - losses[1]) / (2 * step)


@on_devices("share", [None, 0.7])
def test_sky_gradient_matches_the_losses(device, rng, share):
    scene = Scene(device, rng, EnvironmentMap(side=8, cover=0), share)
    view = scene.trainer.compare(scene.photograph, 1)
    view = scene.trainer.backward(view)
    skies, sky = scene.trainer.rasterizer.skies, scene.model.sky
    shown = skies.runs(scene.photograph.camera, 8).texels.get()
    result = scene.trainer.rasterizer.workspace.array("texels", (3, len(shown))).get()
    places = [(int(np.abs(result[channel]).argmax()), channel) for channel in range(3)]
    for place, channel in places:
        expected = numeric(scene, sky.texels, (channel, int(shown[place])), 0.02)
        assert result[channel, place] == pytest.approx(expected, rel=0.01, abs=1e-6)


@on_one_setting
def test_masked_pixels_need_not_show_the_sky(device, rng):
    scene = Scene(device, rng, EnvironmentMap(side=8, cover=0.5, difference=0.5), 0.7)
    view = scene.trainer.compare(scene.photograph, 1)
    behind, mask = view.step.transmittance_gradient.get(), view.comparison.mask.get()
    assert behind.shape == mask.shape
    assert np.abs(behind[mask > 0]).max() > 0
    assert np.abs(behind[mask == 0]).max() == 0


def test_opacity_gradient_includes_the_cover(device, rng):
    """By finite differences, with the pixels that show the sky and those that do not left as they are."""
    scene = Scene(device, rng, EnvironmentMap(side=8, cover=0.5, difference=0.5))
    gaussians, rasterizer = scene.model.gaussians, scene.trainer.rasterizer
    view = scene.trainer.backward(scene.trainer.compare(scene.photograph, 1))
    assert {value.name for value in view.losses} == {"l2", "sky"}
    actual = rasterizer.gradients(scene.model, view.frame, view.pixel_sums)["logit_opacity"].get()[0]
    without = rasterizer.pixel_sums(scene.model, view.frame, view.comparison.gradient)
    plain = rasterizer.gradients(scene.model, view.frame, without)["logit_opacity"].get()[0]
    row = int(np.abs(actual - plain).argmax())
    expected = numeric(scene, gaussians["logit_opacity"], (0, row), 0.02)
    assert actual[row] == pytest.approx(expected, rel=0.03)
    assert abs(plain[row] - expected) > 0.2 * abs(expected)


@on_one_setting
def test_pixel_runs_are_cached_within_a_budget(device, rng):
    scene = Scene(device, rng, EnvironmentMap(side=8))
    camera, workspace = scene.photograph.camera, scene.trainer.rasterizer.workspace
    skies = Skies(device, workspace, cache_size=1)
    first = skies.runs(camera, 8)
    assert skies.runs(camera, 8) is first, "the last camera's are kept, whatever their size"
    assert skies.runs(camera, 16) is not first
    assert skies.runs(camera, 8) is not first
