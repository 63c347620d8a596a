"""Known exposures are found again: photographs of a model that is known, with gains that are known."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.image import L1, Dssim
from clsplat.metrics.views import render_floats
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import DeviceInfo
from clsplat.render.camera import upload_camera
from clsplat.render.painter import Splats
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import Trainer
from clsplat.views.colours import Gain
from clsplat.views.photograph_colours import PhotographColours
from clsplat.views.photographs import Photograph

VIEWS, STEPS = 8, 400
RATES = Rates(means=0, quats=0, log_scales=0, logit_opacity=0, sh_base=2e-2, sh_rest=0)  # the colours alone are unknown
LUMINANCE = np.array([0.299, 0.587, 0.114])


class Capture:
    """Photographs of a model of one colour a Gaussian from places beside each other, each with its gains, in 8 bits."""

    def __init__(self, rng: np.random.Generator, info: DeviceInfo, log_gains: np.ndarray, bright: float = 0.0) -> None:
        """bright: added to the colours of the model."""
        case = replace(random_case(rng, 80, 48, 36), degree=0)
        device = Device(info)
        self.model, self.rasterizer = case.model(device), Rasterizer(device)
        self.background, self.photographs = device.upload(np.full(3, 0.3, np.float32)), list[Photograph]()
        self.colours = 0.5 * case.parameters["sh_base"] + np.float32(bright)
        self.model.gaussians.set("sh_base", self.colours)
        for number, gains in enumerate(log_gains):
            moved = case.view.world_to_camera + np.column_stack(
                [np.zeros((3, 3)), [0.1 * number - 0.4, 0.05 * number, 0]]
            )
            camera = upload_camera(device, replace(case.view, world_to_camera=moved))
            values = np.clip(
                render_floats(Splats(self.rasterizer, self.model, self.background), camera) * np.exp(gains), 0, 1
            )
            pixels = np.ascontiguousarray(np.rint(255 * values).astype(np.uint8).transpose(2, 0, 1))
            self.photographs.append(Photograph(replace(camera, view=number), device.upload(pixels)))

    @property
    def white(self) -> float:
        """The share of values that are white."""
        return float(np.mean([photograph.image() == 255 for photograph in self.photographs]))

    def learned(self, rng: np.random.Generator) -> np.ndarray:
        """Train from other colours; return the logarithms of gains, [VIEWS, 3]."""
        gaussians, numbers = self.model.gaussians, dict[str, float]()
        gaussians.set("sh_base", self.colours + rng.normal(0, 0.3, self.colours.shape).astype(np.float32))
        colours = PhotographColours(
            Gain(), [str(number) for number in range(VIEWS)], Gain().rate_of(STEPS, VIEWS, False)
        )
        colours.begin(numbers, {})
        parts = self.rasterizer, self.model, Adam(gaussians), SplatStats(gaussians, []), self.background
        trainer = Trainer(*parts, (L1(weight=0.8), Dssim(weight=0.2)), RATES, numbers=numbers, colours=colours)
        for step in range(1, STEPS + 1):
            trainer.step(self.photographs[(step * 3) % VIEWS], step)
        return np.log([np.diag(colours.matrix(numbers, number)) for number in range(VIEWS)])


def drawn(rng: np.random.Generator, exposure: float, balance: float) -> np.ndarray:
    """Gains whose means are 0."""
    gains = rng.normal(0, exposure, (VIEWS, 1)) + np.log1p(rng.uniform(-balance, balance, (VIEWS, 3)))
    return gains - gains.mean(axis=0)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_known_exposures_are_found_again(rng, info):
    truth = drawn(rng, 0.25, 0.05)
    found = Capture(rng, info, truth).learned(rng)
    assert rms(truth) > 0.15
    assert rms(found - truth) < 0.02
    assert found @ LUMINANCE == pytest.approx(truth @ LUMINANCE, abs=0.04)


def test_photographs_of_one_exposure_stay_so(rng, info):
    found = Capture(rng, info, np.zeros((VIEWS, 3))).learned(rng)
    assert rms(found @ LUMINANCE) < 0.01


def test_white_pixels_of_a_blown_photograph_do_not_darken_the_scene(rng, info):
    """What is cut says no more than that it is bright."""
    truth = np.zeros((VIEWS, 3))
    truth[2] = 0.6
    truth -= truth.mean(axis=0)
    capture = Capture(rng, info, truth, bright=1.0)
    assert capture.white > 0.05
    found = capture.learned(rng)
    assert rms(found - truth) < 0.03
    model = capture.model.gaussians.get("sh_base")
    seen = np.abs(model - capture.colours).max(axis=1) < 0.25
    assert np.median((model - capture.colours)[seen]) == pytest.approx(0, abs=0.03)
