"""The whole backward pass against the reference, finite differences, and the other schedule."""

from dataclasses import replace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Tol, relative_error
from clsplat.conformance.scenes import SHARP_THRESHOLDS, Case, add_world_filter, random_case, safe_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Frame, Rasterizer
from tests.support.devices import on_devices, on_one_setting
from tests.support.oracle import render_backward

BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)


def gradients_of(
    device: Device, case: Case, weights: np.ndarray, sort: str = "radix"
) -> tuple[dict, Frame, Rasterizer]:
    """Gradients [N, components] of sum(weights * image)."""
    rasterizer, model, camera = Rasterizer(device, sort), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    gradients = rasterizer.gradients(model, frame, rasterizer.pixel_sums(model, frame, device.upload(planes)))
    count = model.gaussians.count
    values = {name: array.get()[:, :count].T for name, array in gradients.arrays.items()}
    values["mean2d"] = gradients.mean2d.get()[:, :count].T
    return values, frame, rasterizer


def expected_gradients(case: Case, weights: np.ndarray, thresholds: ref.Thresholds = SHARP_THRESHOLDS) -> dict:
    splats = case.project(thresholds)
    by_parameter, by_splat = render_backward(
        case.gaussians(),
        case.camera(),
        BACKGROUND,
        case.degree,
        splats,
        weights,
        case.variance,
        case.compensate,
        thresholds,
    )
    sh = by_parameter.pop("sh")
    return {
        **by_parameter,
        "logit_opacity": by_parameter["logit_opacity"][:, None],
        "sh_base": sh[:, 0],
        "sh_rest": sh[:, 1:].reshape(len(sh), -1),
        "mean2d": by_splat.mean2d,
    }


def compare(values: dict, expected: dict, tolerance: float) -> None:
    for name, truth in expected.items():
        assert relative_error(values[name], truth) < tolerance, name


def _faint(parameters: dict[str, np.ndarray]) -> None:
    """Each covers the whole picture, and light comes through all."""
    parameters["log_scales"] += 4
    parameters["logit_opacity"][:] = -4.6


@on_devices("count", [255, 256, 257, 512, 513])
def test_tile_lists_that_end_at_a_batch_boundary(device, rng, count):
    case = safe_case(rng, count, 14, 14, change=_faint)
    weights = rng.normal(size=(3, 14, 14)).astype(np.float32)
    values, frame, _ = gradients_of(device, case, weights)
    assert frame.lists.pairs >= count
    compare(values, expected_gradients(case, weights), Tol.GRADIENT)


@on_devices("count, width, height", [(1, 16, 16), (16, 20, 18), (17, 33, 15), (40, 40, 30), (65, 24, 24)])
def test_gradients(device, rng, count, width, height):
    case = safe_case(rng, count, width, height)
    weights = rng.normal(size=(3, height, width)).astype(np.float32)
    values, *_ = gradients_of(device, case, weights)
    compare(values, expected_gradients(case, weights), Tol.GRADIENT)


@on_devices("variance, compensate", [(0.3, 1.0), (0.1, 1.0)])
def test_gradients_with_filters(device, rng, variance, compensate):
    case = add_world_filter(random_case(rng, 30, 32, 24), rng)
    case = replace(case, variance=variance, compensate=compensate)
    weights = rng.normal(size=(3, 24, 32)).astype(np.float32)
    smooth = Device(device.info, device.schedule)
    smooth.tuning.update(device.tuning, ALPHA_MIN="1e-30f", TRANSMITTANCE_MIN="1e-30f")
    values, *_ = gradients_of(smooth, case, weights)
    compare(values, expected_gradients(case, weights, ref.SMOOTH_THRESHOLDS), Tol.GRADIENT)


def test_finished_pixels_pass_no_gradient_behind(device, rng):
    """Opaque splats in front: those behind get exactly zero, and the rest is right."""
    case = random_case(rng, 400, 32, 32)
    case.parameters["log_scales"] += 0.8
    case.parameters["logit_opacity"] += 3
    weights = rng.normal(size=(3, 32, 32)).astype(np.float32)
    values, frame, _ = gradients_of(device, case, weights)
    expected = expected_gradients(case, weights)
    hidden = ~expected["sh_base"].any(axis=1) & (frame.lists.tile_count.get()[: len(expected["means"])] > 0)
    assert hidden.sum() > 50
    assert (values["means"][hidden] == 0).all()
    compare(values, expected, 5e-3)  # a few pixels lie at a threshold


def test_finite_differences_on_the_device(device, rng):
    """Central differences of the device's own image, thresholds off: independent of the oracle."""
    smooth = Device(device.info, device.schedule)
    smooth.tuning.update(device.tuning, ALPHA_MIN="1e-30f", TRANSMITTANCE_MIN="1e-30f")
    case = random_case(rng, 6, 24, 20)
    weights = rng.normal(size=(3, 20, 24)).astype(np.float32)
    values, *_ = gradients_of(smooth, case, weights)
    rasterizer, camera, background = Rasterizer(smooth, "radix"), case.device_camera(smooth), smooth.upload(BACKGROUND)

    def loss(parameters: dict) -> float:
        frame = rasterizer.forward(replace(case, parameters=parameters).model(smooth), camera, background)
        image = frame.image.get()[:, :20, :24].astype(np.float64)
        return float((image * weights).sum())

    for name, step in (
        ("means", 2e-3),
        ("quats", 4e-3),
        ("log_scales", 4e-3),
        ("logit_opacity", 1e-2),
        ("sh_base", 1e-2),
    ):
        table = case.parameters[name]
        scale = np.abs(values[name]).max()
        for index in list(np.ndindex(table.shape))[::3]:
            sides = []
            for sign in (1, -1):
                moved = table.copy()
                moved[index] += sign * step
                sides.append((loss({**case.parameters, name: moved}), float(moved[index])))
            difference = (sides[0][0] - sides[1][0]) / (sides[0][1] - sides[1][1])
            assert abs(difference - values[name][index]) < 0.02 * scale, (name, index)


@on_one_setting
def test_sorts_give_the_same_bits(device, rng):
    case = random_case(rng, 300, 70, 50)
    weights = rng.normal(size=(3, 50, 70)).astype(np.float32)
    radix, *_ = gradients_of(device, case, weights, "radix")
    bitonic, *_ = gradients_of(device, case, weights, "bitonic")
    for name in radix:
        np.testing.assert_array_equal(radix[name], bitonic[name])


def pixel_sums_of(result: tuple[dict, Frame, Rasterizer]) -> np.ndarray:
    """The sums over pixels of every Gaussian, [PIXEL_SUMS, N], each kind scaled to 1."""
    gradients, _, rasterizer = result
    count = len(gradients["means"])
    pixel_sums = rasterizer.workspace.array("pixel_sums", (PIXEL_SUMS, -(-count // 64) * 64)).get()[:, :count]
    return pixel_sums / np.linalg.norm(pixel_sums, axis=1, keepdims=True)


@on_one_setting
def test_schedules_agree(device, rng):
    """The same sums in another order differ by rounding: 1e-6 in what blending sums over pixels, a little more where
    the way to the parameters amplifies it."""
    case = random_case(rng, 400, 90, 70)
    weights = rng.normal(size=(3, 70, 90)).astype(np.float32)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    mine, theirs = gradients_of(device, case, weights), gradients_of(other, case, weights)
    assert relative_error(pixel_sums_of(mine), pixel_sums_of(theirs)) < 1e-6
    for name in mine[0]:
        assert relative_error(mine[0][name], theirs[0][name]) < 2e-5, name


@on_one_setting
def test_gradients_are_reproducible(device, rng):
    case = random_case(rng, 300, 70, 50)
    weights = rng.normal(size=(3, 50, 70)).astype(np.float32)
    first, *_ = gradients_of(device, case, weights)
    second, *_ = gradients_of(device, case, weights)
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
