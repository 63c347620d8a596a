"""dropout.cl against the float64 reference."""

from dataclasses import replace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.training import DROPOUT, check_dropout, check_hidden
from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.gaussians.gaussians import DropoutMask
from clsplat.render.rasterizer import Rasterizer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices, on_one_setting

COUNTS = (1, 15, 16, 17, 63, 64, 65)


@on_devices("count", COUNTS)
def test_step_drops_what_the_reference_draws(device, rng, count):
    case = replace(random_case(rng, count), dropout=DROPOUT)
    assert_within_bounds(check_dropout(device, case, rng, "the scene"))
    assert_within_bounds(check_hidden(device, case, rng))


def test_filters_and_dropout_multiply(device, rng):
    case = add_world_filter(random_case(rng, 40, variance=0.1, compensate=1.0), rng)
    assert_within_bounds(check_dropout(device, replace(case, dropout=DROPOUT), rng, "the scene"))


def test_dropped_fraction_equals_the_probability():
    drawn = [ref.drop_mask(0.2, 7, step, 500).mean() for step in range(1, 41)]
    assert abs(np.mean(drawn) - 0.2) < 0.01
    assert len(set(drawn)) > 10, "other steps draw others"
    assert not ref.drop_mask(0.0, 7, 1, 500).any()


@on_one_setting
def test_mean_of_many_renders_is_the_full_render(device, rng):
    """Of one layer, in which no Gaussian covers another: opacities are larger by as much as fewer are drawn."""
    case = random_case(rng, 12, 64, 64)
    places = np.stack(np.meshgrid([-0.3, 0, 0.3], [-0.4, -0.15, 0.15, 0.4]), axis=-1).reshape(12, 2) * 3
    pose = case.view.world_to_camera
    case.parameters["means"][:] = (np.column_stack([places, np.full(12, 3.0)]) - pose[:, 3]) @ pose[:, :3]
    case.parameters["log_scales"][:] = np.log(0.05)
    case.parameters["logit_opacity"][:] = 0.5
    model, camera, rasterizer = case.model(device), case.device_camera(device), Rasterizer(device)
    plain = rasterizer.forward(model, camera, device.zeros(3)).image.get().astype(np.float64)
    total, steps = np.zeros_like(plain), 500
    for step in range(steps):
        drawn = replace(model, dropout=DropoutMask(0.2, 3, step))
        total += rasterizer.forward(drawn, camera, device.zeros(3)).image.get()
    assert abs(total.sum() / steps / plain.sum() - 1) < 0.01
    assert plain.sum() > 10
