"""The Haar transform of photographs and its learned filter (haar.cl, AutoOpti3DGS): by float64, in a step, in a run."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.images import check_haar, make_camera, to_planes
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import ConfigError
from clsplat.density.statistics import SplatStats
from clsplat.losses.host import HostLoss
from clsplat.losses.image import L1, L2, Dssim
from clsplat.losses.penalties import Anisotropy
from clsplat.methods.opti3dgs import NAMES, Haar, HaarState, apply_filter
from clsplat.photos.photographs import Photograph, apply_mask
from clsplat.photos.transforms import Planes
from clsplat.pipeline.loading import load
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import StepTrainer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting, product
from tests.support.runs import train

SIZES = ((1, 1), (2, 1), (1, 2), (3, 3), (15, 4), (16, 16), (17, 5), (33, 18), (127, 32), (128, 33), (129, 65))
HAAR = np.array([1.0, -1.0]) / np.sqrt(2)  # the filter that changes nothing
LEAK = np.array([1.0, 1.0]) / np.sqrt(2)
COURSE = {1000: 0.10, 3000: 0.28, 5000: 0.46, 7000: 0.63, 10000: 0.85, 15000: 1.0}  # published


def taps_of(scalars: dict[str, float]) -> np.ndarray:
    """The filter, h0 and h1."""
    return scalars["haar/scale"] * HAAR + scalars.get("haar/leak", 0.0) * LEAK


def apply_haar(device, image: np.ndarray, taps, mask: np.ndarray | None = None) -> np.ndarray:
    """The photograph [3, H, W] after the transform."""
    camera = make_camera(device, image.shape[2], image.shape[1])
    counted = None if mask is None else to_planes(device, camera, mask[None])
    scalars = {"haar/scale": HAAR @ taps, "haar/leak": LEAK @ taps}
    planes = Planes(Workspace(device), camera, to_planes(device, camera, image), counted)
    return apply_filter(planes, scalars).colors.get()[:, : camera.height, : camera.width]


@on_devices("width, height, share", each_once(SIZES, [None, 0.7, 0.1]))
def test_image_and_derivatives_match_the_reference(device, rng, width, height, share):
    for taps in ((0.0, 0.0), HAAR, (0.3, 0.9)):
        assert_within_bounds(check_haar(device, rng, width, height, share, np.array(taps)))


@pytest.mark.parametrize("share", [0.0, 0.37, 1.0, 1.2])
def test_reference_matches_the_closed_form(rng, share):
    """Per block [a b; c d], with means m, h, v, g of its four patterns."""
    image = rng.uniform(0, 1, (3, 6, 8))
    a, b, c, d = image[:, ::2, ::2], image[:, ::2, 1::2], image[:, 1::2, ::2], image[:, 1::2, 1::2]
    m, h, v, g = (a + b + c + d) / 4, (a - b + c - d) / 4, (a + b - c - d) / 4, (a - b - c + d) / 4
    expected = np.empty(image.shape)
    for row, column in np.ndindex(2, 2):
        across, down = (-1) ** column * share, (-1) ** row * share
        expected[:, row::2, column::2] = m + across * h + down * v + across * down * g
    np.testing.assert_allclose(ref.haar_filter(image, share * np.array(HAAR)), expected, atol=1e-14)


@on_devices("masked", [False, True])
def test_unfiltered_haar_is_the_identity(device, rng, masked):
    image = rng.uniform(0, 1, (3, 10, 22)).astype(np.float32)
    mask = rng.random((10, 22)) < 0.6 if masked else np.ones((10, 22), bool)
    squares = np.where(mask, image, np.nan).reshape(3, 5, 2, 11, 2)
    count = mask.reshape(5, 2, 11, 2).sum(axis=(1, 3))
    mean = np.nansum(squares, axis=(2, 4), dtype=np.float64) / np.maximum(count, 1)
    actual = apply_haar(device, image, (0.0, 0.0), mask if masked else None)[:, mask]
    np.testing.assert_allclose(actual, np.kron(mean, np.ones((2, 2)))[:, mask], rtol=1e-6)
    np.testing.assert_allclose(
        apply_haar(device, image, HAAR, mask if masked else None)[:, mask], image[:, mask], atol=3e-7
    )


def test_nonfinite_values_stay_in_their_square(device, rng):
    image = rng.uniform(0, 1, (3, 20, 30)).astype(np.float32)
    image[1, 7, 12] = np.nan
    bad = np.zeros(image.shape, bool)
    bad[1, 6:8, 12:14] = True
    np.testing.assert_array_equal(np.isnan(apply_haar(device, image, (0.2, 0.1))), bad)


def scale_history(haar: Haar, steps: int) -> list[float]:
    """The scale after each step, by the filter's own loss alone, from 0 on."""
    state, course = HaarState(haar), [0.0]
    for step in range(1, steps + 1):
        state.learn(haar.penalty(state.filter, step)[1], step)
        course.append(state.scalars["haar/scale"])
    assert state.scalars.get("haar/leak", 0.0) == 0
    return course


@pytest.mark.parametrize("learn", ["filter", "scale"])
def test_filter_follows_the_published_course(learn):
    """Adam decides it, whatever the weight."""
    for weight in (0.05, 7.0):
        course = scale_history(Haar(learn=learn, weight=weight), 15000)
        assert {step: course[step] for step in COURSE} == pytest.approx(COURSE, abs=0.005)


@pytest.mark.parametrize("learn", ["filter", "scale"])
def test_filter_loss_and_derivatives(learn):
    haar = Haar(learn=learn, weight=0.3)
    at = dict(zip(NAMES[learn], (0.2, -0.5), strict=False))
    value, derivatives = haar.penalty(at, step=1)
    assert value == pytest.approx(0.3 * 2 * ((taps_of(at) - HAAR) ** 2).sum())
    for name in at:
        up, down = (haar.penalty({**at, name: at[name] + e}, step=1)[0] for e in (1e-4, -1e-4))
        assert derivatives[name] == pytest.approx((up - down) / 2e-4, rel=1e-6)


# ---- in a training step


def trainer_of(device, rng, losses, masked: bool = True, **settings) -> tuple[StepTrainer, HaarState, Photograph]:
    case = random_case(rng, 60, 41, 30)
    model = case.model(device)
    parts = Adam(model.gaussians), SplatStats(model.gaussians), device.zeros(3)
    haar = HaarState(Haar(**settings))
    trainer = StepTrainer(Rasterizer(device, "radix"), model, *parts, losses, Rates(), modules=[haar])
    colors = rng.integers(0, 256, (3, 30, 41)).astype(np.uint8)
    mask = device.upload((rng.random((1, 30, 41)) < 0.7).astype(np.uint8)) if masked else None
    return trainer, haar, Photograph(case.device_camera(device), device.upload(colors), mask)


@on_devices("learn, masked", product(["filter", "scale"], [False, True]))
def test_gradient_is_the_sum_over_all_losses(device, rng, learn, masked):
    """Finite differences of the float64 losses of the rendered image, by each number."""
    losses = [L1(weight=0.8), Dssim(weight=0.2), L2(weight=3.0), Anisotropy(above=1.0)]
    trainer, haar, photograph = trainer_of(device, rng, losses, masked, learn=learn, weight=0.01)
    haar.scalars = {name: 0.31 + 0.4 * i for i, name in enumerate(NAMES[learn])}
    before, counted = dict(haar.scalars), photograph.unmasked_pixels()
    view = trainer.differentiate(photograph, 1)
    image = view.comparison.image.get()[:, :30, :41].astype(np.float64)
    colors = photograph.image().transpose(2, 0, 1) / 255

    def total(scalars: dict[str, float]) -> float:
        taps = taps_of(scalars)
        actual = ref.haar_filter(colors, taps, counted) * (1 if counted is None else counted)
        parts = ((0.8, ref.l1), (0.2, ref.dssim), (3.0, ref.l2))
        images = sum(weight * loss(image, actual)[0] for weight, loss in parts)
        return images + 0.01 * 2 * ((taps - HAAR) ** 2).sum()

    expected = {}
    for name, value in before.items():
        up, down = (total({**before, name: value + e}) for e in (1e-6, -1e-6))
        expected[name] = (up - down) / 2e-6
    trainer.update(view)
    for name, gradient in expected.items():
        assert haar.scalars[f"{name}/moment1"] / 0.1 == pytest.approx(gradient, rel=2e-3, abs=1e-5)
        assert haar.scalars[name] == pytest.approx(before[name] - 1e-4 * np.sign(gradient), abs=1e-9)
        assert haar.scalars[f"{name}/updates"] == 1
    own = next(loss.value() for loss in view.losses if loss.name == "haar")
    assert view.loss - view.losses[-1].value() == pytest.approx(total(before), rel=1e-4)
    assert own == pytest.approx(0.01 * 2 * ((taps_of(before) - HAAR) ** 2).sum())


@on_devices("masked", [False, True])
def test_filter_pass_does_not_change_losses_and_gradients(device, rng, masked):
    """Bit for bit those of the changed photograph alone."""
    trainer, _, photograph = trainer_of(device, rng, [L1(weight=0.8), L2(), Dssim(weight=0.2)], masked)
    view = trainer.differentiate(photograph, 1)
    values, gradient = [loss.value() for loss in view.losses[:-1]], view.comparison.gradient.get()
    alone = replace(view.comparison, workspace=Workspace(device), gradient=device.zeros(gradient.shape))
    alone = replace(alone, accumulate=False)
    assert [loss.add(alone).value() for loss in trainer.losses] == values
    if masked:
        apply_mask(alone.workspace, alone.camera, alone.gradient, alone.mask)
    np.testing.assert_array_equal(alone.gradient.get(), gradient)


@on_one_setting
def test_differentiating_records_no_scalars(device, rng):
    trainer, haar, photograph = trainer_of(device, rng, [L1()])
    trainer.differentiate(photograph, 1)
    assert haar.scalars == {}
    trainer.step(photograph, 1)
    assert haar.scalars.keys() > {*NAMES["filter"]}


@on_one_setting
def test_asymmetric_loss_is_refused(device, rng):
    def brightness(image: np.ndarray, photograph: np.ndarray) -> tuple[float, np.ndarray]:
        return float(image.mean()), np.full(image.shape, 1 / image.size)

    trainer, _, photograph = trainer_of(device, rng, [L1(), HostLoss(brightness)])
    refused = r"^the loss 'brightness' is not symmetric .* `symmetric = True`"
    with pytest.raises(ConfigError, match=refused):
        trainer.differentiate(photograph, 1)


@on_one_setting
def test_deferred_copy_holds_the_values_at_its_start(device):
    array = device.upload(np.arange(40, dtype=np.float32))
    copied = array.get_later()
    array.fill(3)
    np.testing.assert_array_equal(copied(), np.arange(40))
    np.testing.assert_array_equal(array.get_later()(), 3)


# ---- in a run


def test_asymmetric_loss_is_refused_before_a_run():
    training = load("smoke", ["optimize.modules=[haar]"]).settings.training
    training.check()
    other = HostLoss(lambda image, photograph: (0.0, image))
    with pytest.raises(ConfigError, match="the loss '<lambda>' is not symmetric"):
        training.model_copy(update={"losses": [*training.losses, other]}).check()


def test_filter_follows_the_same_course_in_fewer_steps():
    """By its own loss: from the mean of squares to the photograph, long before the end."""
    training = load("auto_opti3dgs_7k").settings.training
    course = scale_history(training.modules[0], training.steps)
    assert [course[training.steps * n // 100] for n in (5, 10, 20)] == pytest.approx([0.145, 0.28, 0.53], abs=0.03)
    assert course[training.steps * 6 // 10] == pytest.approx(1, abs=0.03)


@pytest.mark.slow
def test_recipe_trains(tiny_scene, tmp_path):
    """The filter grows from zero at its rate, and evaluation uses the unfiltered photographs."""
    short = ("optimize.steps=30", "optimize.evaluate.every=30", "checkpoint.every=30", "optimize.log_every=10")
    run = train(tiny_scene, tmp_path / "run", *short, pipeline="auto_opti3dgs_7k")
    scalars = run.modules["haar"].scalars
    assert scalars["haar/scale"] == pytest.approx(30 * 4.3e-4, rel=0.1)
    assert abs(scalars["haar/leak"]) < 30 * 4.3e-4
    plain = train(tiny_scene, tmp_path / "plain", *short, pipeline="splat_7k")
    psnr = [item.metrics["test"]["1"]["psnr"] for item in (run, plain)]
    assert psnr[0] == pytest.approx(psnr[1], abs=1.5)
