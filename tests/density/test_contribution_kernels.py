"""The sum of blend weights for pruning, against the reference, at the edges of tiles and groups."""

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.checks.density import black_photograph
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.density.importance import contributions
from clsplat.density.survey import RenderedView
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer, RenderLimits
from tests.support.devices import on_devices, on_one_setting


def weights(rasterizer, model, photographs):
    views = RenderedView.render_all(rasterizer, model, photographs, rasterizer.device.zeros(3))
    return contributions(views, model.gaussians.count)


@on_devices("count, width, height", [(0, 16, 16), (1, 16, 16), (1, 1, 1), (16, 17, 15), (17, 33, 31), (65, 24, 24)])
def test_weights_match_the_reference(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, MARGIN if count < 60 else 2e-6)
    actual = weights(Rasterizer(device, "radix"), case.model(device), [black_photograph(device, case)])
    assert actual.shape == (count,)
    np.testing.assert_allclose(actual, ref.contribution(case.project(), width, height), rtol=1e-4, atol=1e-5)


def test_pixels_beyond_the_edge_do_not_count(device, rng):
    """A splat that fills an image of one pixel fills its whole tile: only the one pixel counts."""
    case = random_case(rng, 1, 1, 1)
    case.parameters["means"][:] = np.linalg.inv(np.vstack([case.view.world_to_camera, [0, 0, 0, 1]]))[:3] @ [0, 0, 3, 1]
    case.parameters["log_scales"][:], case.parameters["logit_opacity"][:] = np.log(50), 3
    actual = weights(Rasterizer(device, "radix"), case.model(device), [black_photograph(device, case)])
    np.testing.assert_allclose(actual, 1 / (1 + np.exp(-3)), rtol=1e-3)


def test_masked_pixels_do_not_count(device, rng):
    case = safe_case(rng, 17, 33, 31, MARGIN)
    mask = rng.random((31, 33)) < 0.5
    rasterizer, model = Rasterizer(device, "radix"), case.model(device)
    halves = [weights(rasterizer, model, [black_photograph(device, case, part)]) for part in (mask, ~mask)]
    whole = weights(rasterizer, model, [black_photograph(device, case)])
    np.testing.assert_allclose(halves[0] + halves[1], whole, rtol=1e-5, atol=1e-6)
    assert (halves[0] < whole).any()


@on_one_setting
def test_sums_over_views_in_bands_have_the_same_bits(device, rng):
    case = random_case(rng, 60, 70, 50)
    photographs = [black_photograph(device, case)] * 3
    whole = weights(Rasterizer(device, "radix"), case.model(device), photographs)
    bands = weights(Rasterizer(device, "radix", RenderLimits(60, 3)), case.model(device), photographs)
    np.testing.assert_array_equal(whole, bands)
    once = weights(Rasterizer(device, "radix"), case.model(device), photographs[:1])
    np.testing.assert_allclose(whole, 3 * once, rtol=1e-6)


@on_one_setting
def test_schedules_agree(device, rng):
    case = random_case(rng, 60, 70, 50)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    mine, theirs = (
        weights(Rasterizer(item, "radix"), case.model(item), [black_photograph(item, case)]) for item in (device, other)
    )
    np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)


@on_devices("name", ["means", "logit_opacity"])
def test_nan_gaussian_is_invisible_and_occludes_nothing(device, rng, name):
    case = safe_case(rng, 17, 33, 31, MARGIN)
    without = {key: table.copy() for key, table in case.parameters.items()}
    case.parameters[name][3] = np.nan
    without["logit_opacity"][3] = -80
    rasterizer = Rasterizer(device, "radix")
    actual = weights(rasterizer, case.model(device), [black_photograph(device, case)])
    case.parameters.update(without)
    np.testing.assert_array_equal(actual, weights(rasterizer, case.model(device), [black_photograph(device, case)]))
    assert actual[3] == 0
