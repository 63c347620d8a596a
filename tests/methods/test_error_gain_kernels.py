"""The predicted gain of a Gaussian: exposure does not change the selection."""

import numpy as np
import pytest
from pydantic import ValidationError

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.images import image_pair, make_comparison
from clsplat.conformance.scenes import random_case
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import SH_C0
from clsplat.losses.base import ViewGradients
from clsplat.losses.image import L1, L2, Dssim, view_error
from clsplat.methods.adc import Clone
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import StepTrainer
from tests.support.devices import on_devices, on_one_setting

SIZES = ((1, 1), (5, 3), (16, 16), (17, 33), (255, 12), (257, 9), (600, 4))
COLUMNS = ("screen_grad", "gain")


@on_devices("width, height", SIZES)
def test_view_error_equals_the_loss(device, rng, width, height):
    """L1 itself, and twice L2: the gradient by the image times what is missing to the photograph."""
    x, y = image_pair(rng, width, height)
    for loss, value, factor in ((L1(weight=0.7), ref.l1, 1), (L2(weight=0.7), ref.l2, 2)):
        comparison = make_comparison(device, x, y)
        loss.add(comparison)
        expected = factor * 0.7 * value(x.astype(np.float64), y.astype(np.float64))[0]
        np.testing.assert_allclose(view_error(comparison).get(), [expected], rtol=1e-5)


@on_one_setting
def test_equal_images_have_zero_error(device, rng):
    x, _ = image_pair(rng, 40, 30)
    assert view_error(make_comparison(device, x, x)).get() == 0


def stats_of(device, count, exposure, losses, mask=None, views=1) -> SplatStats:
    """The columns after training steps without rates at a view that is `exposure` times as bright."""
    rng = np.random.default_rng(7)
    case = random_case(rng, count, 48, 32)
    case.parameters["means"][::4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera: not seen
    case.parameters["sh_base"][:] = exposure * case.parameters["sh_base"] - (1 - exposure) / 2 / SH_C0
    case.parameters["sh_rest"][:] *= exposure
    model, background = case.model(device), device.upload(np.full(3, 0.4 * exposure, np.float32))
    stats = SplatStats(model.gaussians, COLUMNS)
    rates = Rates(means=0.0, log_scales=0.0, quats=0.0, logit_opacity=0.0, sh_base=0.0, sh_rest=0.0)
    trainer = StepTrainer(
        Rasterizer(device, "radix"), model, Adam(model.gaussians), stats, background, losses=losses, rates=rates
    )
    for step in range(1, views + 1):
        colors = (4 * rng.integers(0, 60, (3, 32, 48)) * exposure).astype(np.uint8)
        uploaded = None if mask is None else device.upload(mask[None].astype(np.uint8))
        trainer.step(Photograph(case.device_camera(device), device.upload(colors), uploaded), step)
    return stats


def rows_of(stats: SplatStats, statistic: str, gradient_above: float) -> list[int]:
    """What a rule makes of the Gaussians."""
    edit = Edit(stats.gaussians, stats, SceneScale(1.0), step=600, seed=0)
    Clone(statistic=statistic, gradient_above=gradient_above, size_below=1e9).mark(edit)
    return edit.row_counts().tolist()


@on_one_setting
@pytest.mark.parametrize("exposure", [0.5, 0.25])
def test_half_the_exposure_gives_the_same_selection(device, exposure):
    """That of the gradient itself is another one: it is half as large."""
    bright, dim = (stats_of(device, 60, factor, [L1()]) for factor in (1.0, exposure))
    np.testing.assert_allclose(dim.mean("gain"), bright.mean("gain"), rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(dim.mean("screen_grad"), exposure * bright.mean("screen_grad"), rtol=2e-3, atol=1e-9)
    ordered = np.sort(bright.mean("gain"))
    above = float(ordered[40:42].mean())  # between two of them
    chosen = rows_of(bright, "gain", above)
    assert sum(chosen) == 60 + 19
    assert rows_of(dim, "gain", above) == chosen
    own = float(np.sort(bright.mean("screen_grad"))[40:42].mean())
    assert sum(rows_of(dim, "screen_grad", own)) < sum(rows_of(bright, "screen_grad", own))


@on_one_setting
def test_loss_weight_does_not_change_the_gain(device):
    """Any sum of losses, as it is the loss's own gradient that measures the error."""
    once, thrice = (
        stats_of(device, 60, 1.0, [L1(weight=0.8 * factor), Dssim(weight=0.2 * factor)]) for factor in (1, 3)
    )
    np.testing.assert_allclose(thrice.mean("gain"), once.mean("gain"), rtol=1e-4, atol=1e-7)


@on_one_setting
def test_gain_is_relative_to_the_summed_errors(device):
    """Over all views, also those that do not see it, times their number: twice as many photographs promise twice."""
    mask = np.arange(32 * 48).reshape(32, 48) % 5 > 0
    stats = stats_of(device, 60, 1.0, [L1(weight=0.8), Dssim(weight=0.2)], mask, views=3)
    visible = stats.gaussians.get("stats/seen")[:, 0] > 0
    assert 0 < visible.sum() < 60
    error, gain = (stats.gaussians.get(f"stats/{name}")[:, 0] for name in ("view_error", "gain"))
    assert len(set(error)) == 1
    np.testing.assert_allclose(stats.mean("gain"), gain / error, rtol=1e-6)
    above = float(np.sort(stats.mean("gain"))[40:42].mean())
    chosen = rows_of(stats, "gain", above)
    assert sum(chosen) == 60 + 19
    twice = SplatStats(stats.gaussians, COLUMNS, training_views=2)
    np.testing.assert_array_equal(twice.mean("gain"), 2 * stats.mean("gain"))
    np.testing.assert_array_equal(twice.mean("screen_grad"), stats.mean("screen_grad"))
    assert rows_of(twice, "gain", 2 * above) == chosen
    assert sum(rows_of(twice, "gain", above)) > sum(chosen)


@on_devices("count", [1, 63, 64, 65])
def test_gain_is_the_largest_change_over_all_directions(device, rng, count):
    """A shift by one standard deviation of the splat, in a thousand directions; in pixels of the image."""
    case = random_case(rng, count, 48, 32)
    model, camera = case.model(device), case.device_camera(device)
    frame = Rasterizer(device, "radix").forward(model, camera, device.zeros(3))
    gradient = rng.normal(size=(2, model.gaussians.capacity)).astype(np.float32)
    stats, black = SplatStats(model.gaussians, ["gain"]), np.zeros((3, 32, 48), np.float32)
    stats.add(ViewGradients(frame, make_comparison(device, black, black), [], device.zeros(1)), device.upload(gradient))
    expected, angles = np.zeros(count), np.linspace(0, 2 * np.pi, 1000)
    splats = case.project()
    blended = frame.splats.get()[:count].any(axis=1)  # zero where no pixel of the image shows it
    for i in np.flatnonzero((splats.radius > 0) & blended):
        xx, xy, yy = splats.conic[i]
        variances, axes = np.linalg.eigh(np.linalg.inv([[xx, xy], [xy, yy]]))
        shifts = axes @ (np.sqrt(variances)[:, None] * [np.cos(angles), np.sin(angles)])
        expected[i] = 32 * 48 * (gradient[:, i] @ shifts).max()
    assert expected.any()
    np.testing.assert_allclose(model.gaussians.get("stats/gain")[:, 0], expected, rtol=1e-3)


@on_one_setting
def test_invisible_gaussians_do_not_grow(device):
    stats = stats_of(device, 60, 1.0, [L1()])
    visible = stats.gaussians.get("stats/seen")[:, 0] > 0
    chosen = np.array(rows_of(stats, "gain", 1e-30)) > 1
    assert not chosen[~visible].any()
    assert chosen.any()


@on_devices("count", [0, 1, 2])
def test_gain_is_computed_for_up_to_two_gaussians(device, count):
    stats = stats_of(device, count, 1.0, [L1()])
    assert len(stats.mean("gain")) == count
    assert rows_of(stats, "gain", 1e-30) == [1, 2][:count]  # the first one is behind the camera


def test_threshold_in_another_unit_is_refused():
    """The default belongs to the gradient: with it, everything would grow."""
    for keys in ({"statistic": "gain"}, {"statistic": "screen_grad", "as_many_as": "gain"}):
        with pytest.raises(ValidationError, match="the default 'gradient_above' is not in the unit of 'gain'"):
            Clone(**keys)
        assert Clone(gradient_above=200, **keys).gradient_above == 200
    assert Clone(statistic="gain", as_many_as="screen_grad").gradient_above == 2e-4
