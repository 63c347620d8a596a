"""Known exposures are recovered from photographs of a known model."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.image import L1, Dssim
from clsplat.metrics.images import psnr
from clsplat.metrics.views import render_floats
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import DeviceInfo
from clsplat.photos.photographs import Photograph
from clsplat.render.camera import DeviceCamera, upload_camera
from clsplat.render.painter import SplatPainter
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.bilateral_grid import BilateralGrid, GridState
from clsplat.training.modules.exposure import ColorState, Exposure, ExposureState, Gain
from clsplat.training.trainer import StepTrainer

VIEWS, STEPS = 8, 240
NAMES = [str(number) for number in range(VIEWS)]
RATES = Rates(means=0, quats=0, log_scales=0, logit_opacity=0, sh_base=2e-2, sh_rest=0)  # the colors alone are unknown
LUMINANCE = np.array([0.299, 0.587, 0.114])


class Capture:
    """Photographs of a model of one color a Gaussian from places beside each other, each with its gains, in 8 bits."""

    def __init__(
        self,
        rng: np.random.Generator,
        info: DeviceInfo,
        log_gains: np.ndarray,
        bright: float = 0.0,
        local: Callable[[np.ndarray, int], np.ndarray] | None = None,
    ) -> None:
        """bright: added to the colors of the model; local: the logarithms of more gains, [H, W, 1], by the rendered
        image, [H, W, 3], and the number of the photograph."""
        case = replace(random_case(rng, 80, 48, 36), degree=0)
        device = Device(info)
        self.model, self.rasterizer = case.model(device), Rasterizer(device)
        self.background, self.photographs = device.upload(np.full(3, 0.3, np.float32)), list[Photograph]()
        self.colors = 0.5 * case.parameters["sh_base"] + np.float32(bright)
        self.model.gaussians.set("sh_base", self.colors)
        for number, gains in enumerate(log_gains):
            moved = case.view.world_to_camera + np.column_stack(
                [np.zeros((3, 3)), [0.1 * number - 0.4, 0.05 * number, 0]]
            )
            camera = upload_camera(device, replace(case.view, world_to_camera=moved))
            shown = self.rendered(camera)
            values = np.clip(shown * np.exp(gains + (local(shown, number) if local else 0)), 0, 1)
            pixels = np.ascontiguousarray(np.rint(255 * values).astype(np.uint8).transpose(2, 0, 1))
            self.photographs.append(Photograph(replace(camera, view_index=number), device.upload(pixels)))

    def rendered(self, camera: DeviceCamera) -> np.ndarray:
        """The uncorrected colors of the model, [H, W, 3]."""
        return render_floats(SplatPainter(self.rasterizer, self.model, self.background), camera)

    @property
    def white(self) -> float:
        """The fraction of white values."""
        return float(np.mean([photograph.image() == 255 for photograph in self.photographs]))

    def trained(self, rng: np.random.Generator, state: ColorState) -> StepTrainer:
        """Train from other colors; return the trainer, whose module is the state."""
        gaussians = self.model.gaussians
        gaussians.set("sh_base", self.colors + rng.normal(0, 0.3, self.colors.shape).astype(np.float32))
        state.rate = state.settings.rate_schedule(STEPS, VIEWS, False)
        state.start_from({})
        parts = self.rasterizer, self.model, Adam(gaussians), SplatStats(gaussians, []), self.background
        trainer = StepTrainer(*parts, (L1(weight=0.8), Dssim(weight=0.2)), RATES, modules=[state])
        for step in range(1, STEPS + 1):
            trainer.step(self.photographs[(step * 3) % VIEWS], step)
        return trainer

    def learned(self, rng: np.random.Generator) -> np.ndarray:
        """Train with gains; return their logarithms, [VIEWS, 3]."""
        state = ExposureState(Exposure(), NAMES)
        self.trained(rng, state)
        return np.log([np.diag(state.matrix(number)) for number in range(VIEWS)])

    def shown(self, trainer: StepTrainer, number: int) -> np.ndarray:
        """The image of a training view in the colors of its photograph, [H, W, 3]."""
        view = trainer.compare(self.photographs[number], STEPS)
        height, width = view.frame.camera.height, view.frame.camera.width
        return view.comparison.image.get()[:3, :height, :width].transpose(1, 2, 0)

    def fit(self, trainer: StepTrainer) -> float:
        """The mean PSNR at the training views in the colors of their photographs, dB."""
        pairs = ((self.shown(trainer, number), one.image()) for number, one in enumerate(self.photographs))
        return float(np.mean([psnr(image, photograph) for image, photograph in pairs]))


def draw_gains(rng: np.random.Generator, exposure: float, balance: float) -> np.ndarray:
    """Gains whose means are 0."""
    gains = rng.normal(0, exposure, (VIEWS, 1)) + np.log1p(rng.uniform(-balance, balance, (VIEWS, 3)))
    return gains - gains.mean(axis=0)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_known_exposures_are_found_again(rng, info):
    truth = draw_gains(rng, 0.25, 0.05)
    result = Capture(rng, info, truth).learned(rng)
    assert rms(truth) > 0.15
    assert rms(result - truth) < 0.02
    assert result @ LUMINANCE == pytest.approx(truth @ LUMINANCE, abs=0.04)


def test_images_of_equal_exposure_stay_equal(rng, info):
    result = Capture(rng, info, np.zeros((VIEWS, 3))).learned(rng)
    assert rms(result @ LUMINANCE) < 0.01


def test_blown_out_white_pixels_do_not_darken_the_scene(rng, info):
    """A clipped value only says that it is bright."""
    truth = np.zeros((VIEWS, 3))
    truth[2] = 0.6
    truth -= truth.mean(axis=0)
    capture = Capture(rng, info, truth, bright=1.0)
    assert capture.white > 0.05
    result = capture.learned(rng)
    assert rms(result - truth) < 0.03
    model = capture.model.gaussians.get("sh_base")
    visible = np.abs(model - capture.colors).max(axis=1) < 0.25
    assert np.median((model - capture.colors)[visible]) == pytest.approx(0, abs=0.03)


def test_grids_find_known_exposures_too(rng, info):
    """By what a grid makes of the whole image; it has 768 numbers for what three say."""
    truth = draw_gains(rng, 0.25, 0.05)
    capture = Capture(rng, info, truth)
    trainer = capture.trained(rng, GridState(BilateralGrid(), NAMES, capture.rasterizer.device))
    assert capture.fit(trainer) > 45
    results = []
    for number, photograph in enumerate(capture.photographs):
        own, image = capture.rendered(photograph.camera), capture.shown(trainer, number)
        results.append(np.log(np.diag(Gain().fit_matrix(own.reshape(-1, 3), image.reshape(-1, 3)))))
    assert rms(np.array(results) - truth) < 0.02


def test_grids_follow_a_local_tone_mapping_that_gains_cannot(rng, info):
    """Gains depend on the luminance and on the place, in each photograph in another way."""
    ways = rng.normal(0, 0.4, (VIEWS, 2))
    ways -= ways.mean(axis=0)

    def local(shown: np.ndarray, number: int) -> np.ndarray:
        luminance, across = np.clip(shown @ LUMINANCE, 0, 1)[..., None], np.linspace(-1, 1, shown.shape[1])[:, None]
        return ways[number, 0] * (1 - 2 * luminance) + ways[number, 1] * across

    capture = Capture(rng, info, np.zeros((VIEWS, 3)), local=local)
    states = ExposureState(Exposure(), NAMES), GridState(BilateralGrid(), NAMES, capture.rasterizer.device)
    fits = [capture.fit(capture.trained(rng, state)) for state in states]
    assert fits[0] < 30
    assert fits[1] > fits[0] + 10
