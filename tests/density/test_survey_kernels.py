"""Effects of Gaussians on the pixels of training views (density/survey.py), at the edges of tiles and groups."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.scenes import Case, random_case, safe_case
from clsplat.density.importance import sensitivities
from clsplat.density.survey import BLENDED, SQUARE, WEIGHT, RenderedView, Survey
from clsplat.losses.image import L1, Dssim
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Mask, Photograph
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer, RenderLimits
from tests.support.devices import on_devices, on_one_setting

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)
SIZES = [(0, 16, 16), (1, 16, 16), (1, 1, 1), (16, 17, 15), (17, 33, 31), (65, 24, 24)]


def look_at(
    device: Device, case: Case, rng=None, mask: Mask | None = None, budget: RenderLimits | None = None
) -> RenderedView:
    """The view of a case, with a random photograph."""
    camera, (width, height) = case.device_camera(device), case.size
    colors = np.zeros((3, height, width)) if rng is None else rng.integers(0, 256, (3, height, width))
    uploaded = None if mask is None else device.upload(mask[None].astype(np.uint8))
    photograph = Photograph(camera, device.upload(colors.astype(np.uint8)), uploaded)
    return RenderedView.render(
        Rasterizer(device, "radix", budget), case.model(device), photograph, device.upload(BACKGROUND)
    )


def squares(case: Case) -> np.ndarray:
    width, height = case.size
    unit = [np.ones((height, width)) * (np.arange(3) == channel)[:, None, None] for channel in range(3)]
    background = BACKGROUND.astype(np.float64)
    return sum(ref.falloff_squares(case.project(), width, height, background, gradient) for gradient in unit)


@on_devices("count, width, height", SIZES)
def test_numbers_of_flagged_pixels_are_exact(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, MARGIN if count < 60 else 2e-6)
    flags, mask = rng.random((2, height, width)) < 0.6
    blended = ref.blend_weights(case.project(), width, height) > 0
    look = look_at(device, case, mask=mask)
    np.testing.assert_array_equal(look.sum(BLENDED, flags), (blended & flags & mask).sum(axis=(1, 2)))
    look = look_at(device, case)
    np.testing.assert_array_equal(look.sum(BLENDED, np.ones((height, width))), blended.sum(axis=(1, 2)))
    assert not look.sum(BLENDED).any()


@on_devices("count, width, height", SIZES)
def test_squares_match_the_reference(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, MARGIN if count < 60 else 2e-6)
    look = look_at(device, case)
    views = RenderedView.render_all(look.rasterizer, look.model, [look.photograph] * 2, device.upload(BACKGROUND))
    result = sensitivities(views, look.model.gaussians.count)
    assert result.shape == (count,)
    expected = 2 * squares(case)
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-4 * expected.max(initial=0))


def test_squares_match_finite_differences(rng):
    """The image by the opacity, dI/do = G dI/dalpha, from two images of the reference; dI/dG = o dI/dalpha."""

    def opaque(parameters: dict) -> None:
        parameters["logit_opacity"][:6] = 6  # alphas in the middle are capped, and have no gradient there

    case, step = safe_case(rng, 12, 20, 16, MARGIN, opaque), 1e-7
    splats, background, result = case.project(), BACKGROUND.astype(np.float64), squares(case)
    falloffs = {
        blend_step.splat: blend_step.falloff for blend_step in ref.blend_steps(splats, 20, 16, ref.Thresholds())
    }
    for i, falloff in falloffs.items():
        sides = []
        for sign in (1, -1):
            opacity = splats.opacity.copy()
            opacity[i] += sign * step
            sides.append(ref.blend(replace(splats, opacity=opacity), 20, 16, background)[0])
        grad_falloff = (sides[0] - sides[1]) / (2 * step) * splats.opacity[i] / falloff
        assert result[i] == pytest.approx((grad_falloff**2).sum(), rel=1e-3)


@on_one_setting
def test_other_sums_do_not_change(device, rng):
    case = random_case(rng, 60, 40, 30)
    look = look_at(device, case)
    planes = np.zeros((3, look.frame.camera.rows, look.frame.camera.stride), np.float32)
    planes[:, :30, :40] = rng.normal(size=(3, 30, 40))
    gradient, few = device.upload(planes), {}
    for count in (PIXEL_SUMS, 11, 13, 15):
        texture = device.zeros(planes.shape[1:])
        few[count] = look.rasterizer.pixel_sums(look.model, look.frame, gradient, count, texture).get()[:, :60]
    for count in (11, 13, 15):
        np.testing.assert_allclose(few[count][:PIXEL_SUMS], few[PIXEL_SUMS], rtol=1e-4, atol=1e-6)


def test_bands_and_repetitions_have_the_same_bits(device, rng):
    case = random_case(rng, 60, 70, 50)
    flags = rng.random((50, 70)) < 0.5
    views = [look_at(device, case), look_at(device, case, budget=RenderLimits(60, 3)), look_at(device, case)]
    for number, plane, channel in ((BLENDED, flags, None), (WEIGHT, None, None), (SQUARE, None, 1)):
        actual = [look.sum(number, plane, channel) for look in views]
        assert actual[0].any()
        np.testing.assert_array_equal(actual[0], actual[1])
        np.testing.assert_array_equal(actual[0], actual[2])


@on_one_setting
def test_schedules_agree(device, rng):
    case = random_case(rng, 60, 70, 50)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    flags = rng.random((50, 70)) < 0.5
    mine, theirs = (look_at(item, case) for item in (device, other))
    np.testing.assert_array_equal(mine.sum(BLENDED, flags), theirs.sum(BLENDED, flags))
    expected = mine.sum(SQUARE, channel=2)
    np.testing.assert_allclose(theirs.sum(SQUARE, channel=2), expected, rtol=1e-4, atol=1e-6 * expected.max())


@on_devices("name", ["means", "logit_opacity"])
def test_nan_or_invisible_gaussian_has_no_square(device, rng, name):
    case = safe_case(rng, 17, 33, 31, MARGIN)
    case.parameters["means"][5] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    case.parameters[name][3] = np.nan
    look = look_at(device, case)
    for found in (look.sum(BLENDED, np.ones((31, 33))), look.sum(SQUARE, channel=0)):
        assert np.isfinite(found).all()
        assert found[3] == found[5] == 0
        assert found.any()


@on_devices("masked", [False, True])
def test_errors_and_losses_use_counted_pixels_only(device, rng, masked):
    case = random_case(rng, 30, 33, 17)
    mask = rng.random((17, 33)) < 0.7 if masked else None
    look = look_at(device, case, rng, mask)
    image = look.frame.image.get()[:, :17, :33].astype(np.float64)
    truth = look.photograph.image().transpose(2, 0, 1) / 255
    np.testing.assert_allclose(look.error(), np.abs(image - truth).mean(axis=0), atol=1e-6)
    counted = np.ones((17, 33)) if mask is None else mask
    np.testing.assert_array_equal(look.counted_pixels(), counted > 0)
    expected = 0.8 * ref.l1(image * counted, truth * counted)[0] + 0.2 * ref.dssim(image * counted, truth * counted)[0]
    before = look.sum(WEIGHT)
    assert look.loss([L1(weight=0.8), Dssim(weight=0.2)]) == pytest.approx(expected, rel=1e-5)
    np.testing.assert_array_equal(look.sum(WEIGHT), before)


def test_views_are_sampled_by_seed_and_step():
    views = list(range(25))

    def drawn(number: int, seed: int, step: int) -> list[int]:
        return Survey(None, None, None, views, seed, step).sample_views(number)

    samples = drawn(10, seed=1, step=600)
    assert len(set(samples)) == 10
    assert samples == sorted(samples) == drawn(10, seed=1, step=600)
    assert samples not in (drawn(10, seed=2, step=600), drawn(10, seed=1, step=700))
    assert drawn(25, seed=1, step=600) == drawn(99, seed=1, step=600) == views
    counts = np.bincount(np.concatenate([drawn(10, 1, step) for step in range(500)]), minlength=25)
    assert counts.min() > 140, "200 expected"
    assert counts.max() < 260


def test_rules_share_cached_results():
    survey, asked = Survey(None, None, None, [], 0, 0), []

    def found(given: Survey, number: int) -> int:
        asked.append((given, number))
        return number + 1

    assert [survey.compute_once(found, number) for number in (1, 2, 1)] == [2, 3, 2]
    assert asked == [(survey, 1), (survey, 2)]
