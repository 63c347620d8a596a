"""The entropy of blend weights: the fourth image plane, its gradient, and its loss."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.check import GRADIENT, relative_error
from clsplat.conformance.checks.blending import BACKGROUND, make_dim
from clsplat.conformance.checks.images import make_comparison
from clsplat.conformance.scenes import Case, random_case, safe_case
from clsplat.core.errors import ConfigError
from clsplat.losses.base import Comparison
from clsplat.losses.host import HostLoss
from clsplat.losses.image import L1, WeightEntropy
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer, RenderLimits
from clsplat.stages.optimize import Optimize
from tests.support.deviations import assert_schedules_agree
from tests.support.device_images import SIZES, trainer_of
from tests.support.devices import on_devices, on_one_setting, product


def entropy_of(device: Device, case: Case, sort: str = "radix") -> np.ndarray:
    """The fourth plane, [H,W]; the other three must have the bits of an image without it."""
    rasterizer, model, camera = Rasterizer(device, sort), case.model(device), case.device_camera(device)
    background, (width, height) = device.upload(BACKGROUND), case.size
    plain = rasterizer.forward(model, camera, background).image.get()
    found = rasterizer.forward(model, camera, background, "entropy").image.get()
    assert (plain.shape[0], found.shape[0]) == (3, 4)
    np.testing.assert_array_equal(found[:3], plain)
    assert (found[3, height:] == 0).all()
    assert (found[3, :, width:] == 0).all()
    return found[3, :height, :width]


def pixel_sums_of(device: Device, case: Case, weights: np.ndarray, budget: RenderLimits | None = None) -> np.ndarray:
    """Sums over each Gaussian's pixels under the loss Σ weights · (image, entropy), [N, PIXEL_SUMS]."""
    rasterizer, model, camera = Rasterizer(device, "radix", budget), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND), "entropy")
    planes = np.zeros((4, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    return rasterizer.pixel_sums(model, frame, device.upload(planes)).get()[:, : model.gaussians.count].T


def gradients_of(m: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "opacity": m[:, 0],
        "conic": np.stack([-0.5 * m[:, 3], -m[:, 4], -0.5 * m[:, 5]], axis=1),
        "color": m[:, 6:9],
    }


def oracle(case: Case, weights: np.ndarray) -> dict[str, np.ndarray]:
    splats = case.project()
    grad = ref.blend_backward(splats, *case.size, BACKGROUND.astype(np.float64), weights.astype(np.float64))
    return {"opacity": grad.opacity * splats.opacity, "conic": grad.conic, "color": grad.color}


def test_reference_is_the_entropy_of_pixel_weights():
    """Two splats over one pixel, by hand."""
    case = random_case(np.random.default_rng(0), 2, 1, 1)
    splats = case.project(ref.SMOOTH)
    splats.mean2d[:], splats.opacity[:], splats.visible[:], splats.depth[:] = 0.5, [0.5, 0.4], True, [1, 2]
    shares = np.array([0.5, 0.2, 0.3])
    found = ref.weight_entropy(splats, 1, 1, ref.SMOOTH)
    assert found[0, 0] == pytest.approx(-(shares * np.log(shares)).sum(), rel=1e-12)


def test_reference_gradient_matches_finite_differences(rng):
    case = random_case(rng, 6, 24, 20)
    splats, weights = case.project(ref.SMOOTH), rng.normal(size=(4, 20, 24))
    found = ref.blend_backward(splats, 24, 20, BACKGROUND, weights, ref.SMOOTH)

    def loss(name: str, place: tuple[int, ...], step: float) -> float:
        table = getattr(splats, name).copy()
        table[place] += step
        moved = replace(splats, **{name: table})
        image, *_ = ref.blend(moved, 24, 20, BACKGROUND, ref.SMOOTH)
        entropy = ref.weight_entropy(moved, 24, 20, ref.SMOOTH)
        return float((weights[:3] * image).sum() + (weights[3] * entropy).sum())

    capped = splats.opacity > 0.98
    for name in ("mean2d", "conic", "opacity", "color"):
        values = getattr(found, name)
        for place in np.ndindex(values.shape):
            if capped[place[0]]:
                continue
            difference = (loss(name, place, 1e-5) - loss(name, place, -1e-5)) / 2e-5
            assert difference == pytest.approx(values[place], rel=1e-4, abs=1e-6 * np.abs(values).max())


@on_devices("count, width, height", [(0, 16, 16), (40, 40, 30), (30, 5, 3)])
def test_plane_and_gradient(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, 1e-5)
    expected = ref.weight_entropy(case.project(), width, height)
    np.testing.assert_allclose(entropy_of(device, case), expected, atol=2e-5)
    weights = rng.normal(size=(4, height, width)).astype(np.float32)
    for planes in (weights, weights * [[[0]], [[0]], [[0]], [[1]]]):
        found, truth = gradients_of(pixel_sums_of(device, case, planes)), oracle(case, planes)
        for name, value in truth.items():
            assert relative_error(found[name], value) < GRADIENT, name


def test_long_tiles_dim_and_finished_pixels(device, rng):
    for change in (make_dim, lambda p: (p["log_scales"].__iadd__(0.6), p["logit_opacity"].__iadd__(2))):
        case = safe_case(rng, 300, 14, 14, 2e-6, change)
        expected = ref.weight_entropy(case.project(), 14, 14)
        np.testing.assert_allclose(entropy_of(device, case), expected, atol=1e-4)
        weights = rng.normal(size=(4, 14, 14)).astype(np.float32)
        found, truth = gradients_of(pixel_sums_of(device, case, weights)), oracle(case, weights)
        for name, value in truth.items():
            assert relative_error(found[name], value) < 5 * GRADIENT, name


def test_schedules_sorts_and_bands_agree(device, rng):
    case = random_case(rng, 150, 50, 70)
    weights = rng.normal(size=(4, 70, 50)).astype(np.float32)
    entropy, sums = entropy_of(device, case), pixel_sums_of(device, case, weights)
    np.testing.assert_array_equal(entropy_of(device, case, "bitonic"), entropy)
    np.testing.assert_array_equal(pixel_sums_of(device, case, weights, RenderLimits(250, 3)), sums)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    assert_schedules_agree(device, entropy_of(other, case), entropy)
    assert relative_error(pixel_sums_of(other, case, weights), sums) < 1e-5


def test_zero_entropy_weight_gives_the_sums_of_plain_steps(device, rng):
    case, weights = random_case(rng, 80), rng.normal(size=(4, 30, 40)).astype(np.float32)
    weights[3] = 0
    rasterizer, model, camera = Rasterizer(device, "radix"), case.model(device), case.device_camera(device)
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, :30, :40] = weights[:3]
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    plain = rasterizer.pixel_sums(model, frame, device.upload(planes)).get()[:, :80].T
    assert plain.shape[1] == PIXEL_SUMS
    assert relative_error(pixel_sums_of(device, case, weights), plain) < 1e-6


def with_entropy(device: Device, rng, width: int, height: int) -> tuple[Comparison, np.ndarray]:
    """A comparison whose image has a fourth plane, and that plane; its gradient is 7 everywhere."""
    x = rng.uniform(0, 1, (4, height, width)).astype(np.float32)
    comparison = make_comparison(device, x, x[:3])
    gradient = device.zeros((4, comparison.camera.rows, comparison.camera.stride))
    gradient.fill(7)
    return replace(comparison, gradient=gradient), x[3]


@on_devices("width, height", SIZES[3:9])
def test_loss_value_and_gradient(device, rng, width, height):
    comparison, entropy = with_entropy(device, rng, width, height)
    value = WeightEntropy(weight=[[0, 0.5], [10, 1.5]]).add(replace(comparison, step=5))
    assert value.name == "weight_entropy"
    assert value.value() == pytest.approx(entropy.astype(np.float64).mean(), rel=1e-6)
    planes = comparison.gradient.get()
    assert (planes[:3] == 7).all()
    np.testing.assert_allclose(planes[3, :height, :width] - 7, 1 / (width * height), rtol=1e-5, atol=1e-6)
    planes[3, :height, :width] = 7
    assert (planes[3] == 7).all(), "nothing is added outside the image"


@on_one_setting
def test_frame_without_the_plane_is_refused(device, rng):
    x = rng.uniform(0, 1, (3, 5, 5)).astype(np.float32)
    with pytest.raises(ConfigError, match="weight_entropy needs a frame with the content 'entropy'"):
        WeightEntropy().add(make_comparison(device, x, x))


def mean_difference(image: np.ndarray, photograph: np.ndarray) -> tuple[float, np.ndarray]:
    difference = image - photograph
    return float(np.abs(difference).mean()), np.sign(difference) / difference.size


@on_devices("first, colors", product([True, False], [L1(), HostLoss(mean_difference)]))
def test_trainer_adds_entropy_to_losses_in_any_order(device, rng, colors, first):
    """With a mask, whose pixels count in no plane."""
    entropy = WeightEntropy(weight=0.3)
    losses = [entropy, colors, entropy] if first else [colors, entropy, entropy]
    trainer, photograph = trainer_of(device, rng, losses)
    comparison = trainer.differentiate(photograph, 1).comparison
    image, gradient = comparison.image.get()[:, :30, :40], comparison.gradient.get()
    assert (gradient[:, :30, :13] == 0).all()
    np.testing.assert_allclose(gradient[3, :30, 13:40], 2 * 0.3 / 1200, rtol=1e-5)
    assert np.abs(gradient[:3, :30, 13:40]).max() > 0
    assert (gradient[:, 30:] == 0).all()
    values = {one.name: one.value() for one in trainer.differentiate(photograph, 1).losses}
    assert values["weight_entropy"] == pytest.approx(0.3 * image[3].sum(dtype=np.float64) / 1200, rel=1e-5)
    assert (image[3, :, :13] == 0).all()
    assert image[3, :, 13:].mean() > 0.05


@on_one_setting
def test_steps_with_only_this_loss_lower_the_entropy(device, rng):
    trainer, photograph = trainer_of(device, rng, [L1(weight=0.0), WeightEntropy(weight=1.0)])
    values = [trainer.step(photograph, step).loss for step in range(1, 40)]
    assert values[-1] < 0.8 * values[0]


def test_training_also_needs_a_loss_on_colors():
    with pytest.raises(ValueError, match="at least one loss must compare images"):
        Optimize(steps=3, losses=[WeightEntropy()])
