"""project.cl and the derivatives by the pose of a camera (poses.cl) against the float64 oracle."""

from dataclasses import replace

import numpy as np

from clsplat.conformance.checks.projection import (
    check_gradient,
    check_hidden,
    check_pose,
    check_record,
    clamped_case,
    project_records,
    undrawable_case,
)
from clsplat.conformance.scenes import Case, add_world_filter, random_case
from clsplat.gaussians.gaussians import HIDDEN_VIEWS, hide
from clsplat.render.camera import CAMERA
from clsplat.render.rasterizer import RECORD, Rasterizer, RenderLimits
from tests.support.deviations import assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting

COUNTS = (7, 8, 9, 16, 63, 64, 200)  # others are in the checks of projection.py


def compare(device, case: Case) -> None:
    assert_within_bounds(check_record(device, case, "the scene"))


@on_devices("count", COUNTS)
def test_records_at_group_edges(device, rng, count):
    compare(device, random_case(rng, count))


@on_devices("variance, compensate", [(0.3, 0.0)])
def test_filters(device, rng, variance, compensate):
    compare(device, add_world_filter(random_case(rng, 60, variance=variance, compensate=compensate), rng))


@on_devices("count, views", each_once(COUNTS, [1, HIDDEN_VIEWS, 2 * HIDDEN_VIEWS + 1]))
def test_view_omits_gaussians_hidden_in_it(device, rng, count, views):
    assert_within_bounds(check_hidden(device, random_case(rng, count), rng, views))


@on_one_setting
def test_other_renders_omit_nothing(device, rng):
    case = random_case(rng, 40)
    model, camera = case.model(device), case.device_camera(device)
    rasterizer = Rasterizer(device)
    expected = rasterizer.forward(model, camera, device.zeros(3)).image.get().copy()
    hide(model.gaussians, np.ones((3, 40), bool))
    np.testing.assert_array_equal(rasterizer.forward(model, camera, device.zeros(3)).image.get(), expected)
    nothing = rasterizer.forward(model, replace(camera, view_index=1), device.zeros(3)).image.get()
    assert expected.any()
    assert not nothing.any()


@on_one_setting
def test_bands_omit_the_same_gaussians(device, rng):
    """A frame in several bands is projected again by the backward pass."""
    case = random_case(rng, 60, 70, 50)
    model, camera = case.model(device), replace(case.device_camera(device), view_index=1)
    hide(model.gaussians, rng.random((2, 60)) < 0.5)
    sums = []
    for budget in (None, RenderLimits(40)):
        rasterizer = Rasterizer(device, "radix", budget)
        frame = rasterizer.forward(model, camera, device.zeros(3))
        gradient = device.upload(np.ones((3, camera.rows, camera.stride), np.float32))
        sums.append(rasterizer.pixel_sums(model, frame, gradient).get()[:, :60].copy())
    assert len(frame.bands) > 1
    np.testing.assert_array_equal(sums[0] == 0, sums[1] == 0)
    np.testing.assert_allclose(sums[1], sums[0], rtol=1e-4, atol=1e-5)


@on_one_setting
def test_nothing_to_project(device, rng):
    records, keys, _ = project_records(device, random_case(rng, 0))
    assert records.shape == (0, RECORD)
    assert keys.shape == (0,)


@on_one_setting
def test_degenerate_gaussians_are_culled(device, rng):
    case = undrawable_case(rng)
    records, keys, radius = project_records(device, case)
    for n in (0, 1, 2, 3, 4, 5, 7, 8):
        assert (records[n] == 0).all(), n
        assert keys[n] == 0xFFFFFFFF
    assert (radius[:6] == 0).all()
    assert np.isfinite(records).all() or not np.isnan(records).any()
    compare(device, Case({k: v[9:] for k, v in case.parameters.items()}, case.view))


@on_one_setting
def test_camera_struct_has_the_kernels_layout(device):
    assert CAMERA.itemsize == 4 * 27
    assert all(CAMERA.fields[name][1] % 4 == 0 for name in CAMERA.names)


def backward_case(device, rng, case: Case) -> None:
    assert_within_bounds(check_gradient(device, case, rng, "the scene"))


@on_devices("count", COUNTS)
def test_gradients_at_group_edges(device, rng, count):
    backward_case(device, rng, random_case(rng, count))


@on_devices("variance, compensate", [(0.3, 0.0)])
def test_gradients_through_the_filters(device, rng, variance, compensate):
    backward_case(device, rng, add_world_filter(random_case(rng, 60, variance=variance, compensate=compensate), rng))


@on_one_setting
def test_gradients_where_the_ray_is_clamped(device, rng):
    case = clamped_case(rng)
    in_camera = case.parameters["means"] @ case.camera().rotation.T + case.camera().translation
    limits = case.device_camera(device).array.get()[0]
    assert (np.abs(in_camera[:, 0] / in_camera[:, 2]) > limits["ray_x_max"]).any()
    backward_case(device, rng, case)


@on_devices("count", [16, 64, 511, 513])
def test_sums_over_groups(device, rng, count):
    assert_within_bounds(check_pose(device, random_case(rng, count), rng, f"{count} Gaussians"))
