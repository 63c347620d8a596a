"""Gaussians at a given time, and gradients of their motion (motion.cl), against float64."""

from dataclasses import replace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Tol, relative_error
from clsplat.conformance.checks.motion import TIME, check_motion_at_time, motion, moving_case
from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.formats.splats import MOTION, PARAMETERS, STATIC_LOG_DURATION, WIDTHS, motion_width
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.gaussians.model import Model
from clsplat.losses.base import Comparison, ViewGradients
from clsplat.render.motion import evaluate_motion
from clsplat.render.rasterizer import Rasterizer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices, on_one_setting


def test_motion_and_its_gradients(device, rng):
    assert_within_bounds(motion(device, rng))


@on_devices("count", [16, 63, 64, 129])
def test_sizes_around_the_groups(device, rng, count):
    assert_within_bounds(check_motion_at_time(device, rng, count, motion_width(2, True)))


@on_one_setting
def test_host_and_device_snapshots_render_alike(device, rng):
    case = moving_case(rng, 65, motion_width(3, True))
    model = Model(**case.parameters)
    camera, rasterizer = case.device_camera(device), Rasterizer(device, "radix")
    moving = rasterizer.forward(case.model(device), camera, device.zeros(3)).image.get()
    static = model.at(case.view.time)
    assert static.motion is None
    assert 0 < len(static) < len(model)
    same_numbers = replace(case.model(device), gaussians=static.upload(device).gaussians)
    drawn = rasterizer.forward(same_numbers, camera, device.zeros(3))
    np.testing.assert_allclose(drawn.image.get(), moving, atol=2e-5)


def test_image_gradients_reach_the_motion(device, rng):
    """Those of a static model of the moment, carried back in float64, are what the rasterizer returns."""
    case, width = moving_case(rng, 65, motion_width(2, True)), motion_width(2, True)
    camera, rasterizer, p = case.device_camera(device), Rasterizer(device, "radix"), case.parameters
    weights = np.zeros((3, camera.rows, camera.stride), np.float32)
    weights[:, : camera.height, : camera.width] = rng.normal(size=(3, camera.height, camera.width))

    def gradients_of(model: DeviceModel) -> dict[str, np.ndarray]:
        frame = rasterizer.forward(model, camera, device.zeros(3))
        found = rasterizer.gradients(model, frame, rasterizer.pixel_sums(model, frame, device.upload(weights)))
        return {name: array.get()[:, :65].T.astype(np.float64) for name, array in found.arrays.items()}

    model = case.model(device)
    moment = evaluate_motion(rasterizer.workspace, model, camera).gaussians
    tables = {name: moment.get(name) for name in PARAMETERS}
    static = gradients_of(replace(model, gaussians=Gaussians(device, tables)))
    upstream = static["means"], static["quats"], static["logit_opacity"][:, 0]
    logit = p["logit_opacity"][:, 0].astype(np.float64)
    grad_motion, grad_logit = ref.move_gaussians_backward(
        p[MOTION].astype(np.float64), logit, *upstream, TIME, *WIDTHS[width]
    )
    found = gradients_of(model)
    for column in range(width):
        assert relative_error(found[MOTION][:, column], grad_motion[:, column]) < Tol.CONIC
    assert relative_error(found["logit_opacity"][:, 0], grad_logit) < Tol.CONIC
    for name in ("means", "quats", "log_scales", "sh_base", "sh_rest"):
        np.testing.assert_array_equal(found[name], static[name])


def test_static_motion_has_the_bits_of_no_motion(device, rng):
    case = random_case(rng, 65)
    still = np.zeros((65, 5), np.float32)
    still[:, 3], still[:, 4] = rng.uniform(0, 1, 65), STATIC_LOG_DURATION
    moving = replace(case, parameters={**case.parameters, MOTION: still}, view=replace(case.view, time=0.625))
    results = []
    for one in (case, moving):
        rasterizer, model, camera = Rasterizer(device, "radix"), one.model(device), one.device_camera(device)
        frame = rasterizer.forward(model, camera, device.zeros(3))
        sums = rasterizer.pixel_sums(model, frame, device.upload(np.ones(frame.image.shape, np.float32)))
        gradients = rasterizer.gradients(model, frame, sums)
        radius = frame.radius.get()[:65]
        results.append([frame.image.get(), radius, *(gradients[name].get()[:, :65] for name in case.parameters)])
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


@on_one_setting
def test_absent_gaussians_are_invisible(device, rng):
    case = moving_case(rng, 65)
    frame = Rasterizer(device, "radix").forward(case.model(device), case.device_camera(device), device.zeros(3))
    absent = np.zeros(65, bool)
    absent[::10] = True
    assert (frame.radius.get()[:65][absent] == 0).all()
    assert (frame.radius.get()[:65][~absent] > 0).mean() > 0.5


def test_splitting_matrices_belong_to_the_time_of_the_view(device, rng):
    case = moving_case(rng, 65, motion_width(3, True))
    camera, background = case.device_camera(device), device.zeros(3)
    weights = device.upload(rng.normal(size=(3, camera.rows, camera.stride)).astype(np.float32))
    rasterizer, results = Rasterizer(device, "radix"), []
    moment = evaluate_motion(rasterizer.workspace, case.model(device), camera).gaussians
    static = Gaussians(device, {name: moment.get(name) for name in PARAMETERS})
    for model in (case.model(device), replace(case.model(device), gaussians=static)):
        frame = rasterizer.forward(model, camera, background)
        pixel_sums = rasterizer.pixel_sums(model, frame, weights)
        stats = SplatStats(model.gaussians, ("splitting",))
        comparison = Comparison(rasterizer.workspace, camera, frame.image, frame.image, frame.image)
        stats.add(ViewGradients(frame, comparison, [], pixel_sums), pixel_sums)
        results.append(model.gaussians.get("stats/splitting"))
    assert np.abs(results[1]).max() > 0
    np.testing.assert_array_equal(*results)
