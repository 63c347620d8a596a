"""Splats over the box of each pixel: the formula against the integral, the reference against finite differences, and
the kernels against the reference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import check_blend, check_sum, render, sum_pixels
from clsplat.conformance.checks.pixel_box import BOX, SIZES, sized_case
from clsplat.conformance.checks.projection import check_record, project_records, undrawable_case
from clsplat.conformance.reference.blending import box_derivatives, box_response
from clsplat.conformance.scenes import Case, random_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from tests.support.deviations import assert_schedules_agree
from tests.support.devices import each_once, on_devices, on_one_setting
from tests.support.oracle import render_backward

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)
PIECES = 6


def covariance(sigma: float, ratio: float, degrees: float) -> np.ndarray:
    """xx, xy, yy of a splat whose smaller standard deviation is `sigma`, px."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    long, short = (sigma * ratio) ** 2, sigma**2
    return np.array([c * c * long + s * s * short, c * s * (long - short), s * s * long + c * c * short])


def integral(v: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """The mean over the pixel: exact in x, Gauss-Legendre in y."""
    xx, xy, yy = v
    sy, k = np.sqrt(yy), xy / yy
    sx = np.sqrt(xx - xy * k)
    low, high = np.maximum(dy - 0.5, -9 * sy), np.minimum(dy + 0.5, 9 * sy)
    total = np.zeros(dx.shape)
    for piece in range(PIECES):
        a, b = (low + (high - low) * part / PIECES for part in (piece, piece + 1))
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            y = (a + b) / 2 + (b - a) / 2 * node
            across = ndtr((dx + 0.5 - k * y) / sx) - ndtr((dx - 0.5 - k * y) / sx)
            inner = np.exp(-0.5 * (y / sy) ** 2) * sx * np.sqrt(2 * np.pi) * across
            total += np.where(high > low, weight * (b - a) / 2 * inner, 0)
    return total


def pixels_around(v: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    reach = int(np.ceil(3.4 * np.sqrt(max(v[0], v[2])) + 2))
    grid = np.arange(-reach, reach + 1)
    dx, dy = np.meshgrid(grid - rng.uniform(-0.5, 0.5), grid - rng.uniform(-0.5, 0.5))
    return dx, dy


BOUNDS = {  # (ratio, degrees) -> error by the norm of the integral, at smaller standard deviations of 0.1, 0.2, … px
    (1, 0): (2e-4, 2e-4, 2e-4, 3e-4, 5e-4, 6e-4),
    (2, 30): (4e-3, 3e-3, 2e-3, 1e-3, 5e-4, 6e-4),
    (4, 22.5): (1.2e-2, 5e-3, 2e-3, 6e-4, 5e-4, 6e-4),
    (4, 45): (6e-2, 3e-2, 1e-2, 3e-3, 6e-4, 6e-4),
    (4, 67.5): (1.2e-2, 5e-3, 2e-3, 6e-4, 5e-4, 6e-4),
    (16, 10): (3e-3, 1.5e-3, 5e-4, 4e-4, 5e-4, 6e-4),
    (16, 45): (9e-2, 3e-2, 7e-3, 1e-3, 5e-4, 6e-4),
}


@pytest.mark.parametrize(("ratio", "degrees"), BOUNDS)
def test_formula_matches_the_integral(rng, ratio, degrees):
    for sigma, bound in zip((0.1, 0.2, 0.3, 0.5, 1.0, 3.0), BOUNDS[ratio, degrees], strict=True):
        v = covariance(sigma, ratio, degrees)
        dx, dy = pixels_around(v, rng)
        truth = integral(v, dx, dy)
        error = box_response(v, dx, dy) - truth
        assert np.linalg.norm(error) <= bound * np.linalg.norm(truth), f"{sigma} px"
        assert np.abs(error).max() <= {0.1: 0.03, 0.2: 0.015, 0.3: 0.006}.get(sigma, 0.004), f"{sigma} px"


def test_blur_of_a_tenth_is_less_accurate(rng):
    """What the filter is for: Mip-Splatting's blur is off by several percent where splats are small."""
    v = covariance(0.3, 4, 22.5)
    dx, dy = pixels_around(v, rng)
    truth = integral(v, dx, dy)
    a, b, c = v[0] + 0.1, v[1], v[2] + 0.1
    determinant = a * c - b * b
    blur = np.exp(-0.5 * (c * dx * dx + a * dy * dy - 2 * b * dx * dy) / determinant)
    blur *= np.sqrt((v[0] * v[2] - v[1] ** 2) / determinant)
    mine, theirs = (np.linalg.norm(found - truth) for found in (box_response(v, dx, dy), blur))
    assert mine < theirs / 10


@pytest.mark.parametrize(("degrees", "sigma"), each_once([0, 20, 70, 110, 160], [0.15, 0.5, 2.0]))
def test_reference_derivatives_match_the_integral(rng, sigma, degrees):
    """Finite differences of the formula against finite differences of the integral, which the formula only nears."""
    v, step = covariance(sigma, 2.5, degrees), 1e-3 * sigma
    dx, dy = pixels_around(v, rng)
    by_x = (integral(v, dx + step, dy) - integral(v, dx - step, dy)) / (2 * step)
    by_y = (integral(v, dx, dy + step) - integral(v, dx, dy - step)) / (2 * step)
    for found, truth in zip(box_derivatives(v, dx, dy), (by_x, by_y), strict=False):
        assert np.linalg.norm(found - truth) < 0.04 * np.linalg.norm(truth)


def test_formula_is_continuous_where_the_axes_swap(rng):
    v = covariance(0.4, 4, 45)
    dx, dy = pixels_around(v, rng)
    by = 1e-9 * np.array([1, 0, -1])
    first, other = box_response(v + by, dx, dy), box_response(v - by, dx, dy)
    assert 0 < np.linalg.norm(first - other) < 0.01 * np.linalg.norm(first)


def test_reference_gradients_match_finite_differences(rng):
    """Of the whole way from a parameter to the image, with nothing skipped."""
    case = random_case(rng, 3, 16, 12, **BOX)
    weights, black = rng.normal(size=(3, 12, 16)), np.zeros(3)

    def rendered(gaussians: ref.RawGaussians) -> ref.blending.RenderOutput:
        return ref.render(gaussians, case.camera(), black, 3, 0.2, 0.0, 0.0, ref.SMOOTH_THRESHOLDS, 1.0)

    gaussians = case.gaussians()
    splats = rendered(gaussians).splats
    actual, _ = render_backward(gaussians, case.camera(), black, 3, splats, weights, 0.0, 0.0, ref.SMOOTH_THRESHOLDS)
    for name in ("means", "quats", "log_scales", "logit_opacity"):
        table = getattr(gaussians, name)
        truth = np.zeros_like(table)
        for place in np.ndindex(table.shape):
            ends = []
            for sign in (1, -1):
                moved = table.copy()
                moved[place] += sign * 1e-5
                ends.append(np.sum(weights * rendered(replace(gaussians, **{name: moved})).image))
            truth[place] = (ends[0] - ends[1]) / 2e-5
        assert np.linalg.norm(actual[name] - truth) < 1e-4 * np.linalg.norm(truth), name


def assert_within_bounds(deviations) -> None:
    for deviation in deviations:
        assert deviation.passes, deviation.text


@on_devices("width, height, size", each_once([(16, 16), (17, 15), (33, 31), (5, 3)], SIZES))
def test_edges_of_tiles(device, rng, width, height, size):
    case = sized_case(SIZES[size], rng, 20, width, height)
    assert_within_bounds(check_blend(device, case, size))
    weights = rng.normal(size=(3, height, width)).astype(np.float32)
    assert_within_bounds(check_sum(case, sum_pixels(device, case, weights, 11), weights, size))


def test_degenerate_splats_are_not_drawn(device, rng):
    case = replace(undrawable_case(rng), **BOX)
    records, keys, _ = project_records(device, case)
    culled = [0, 1, 2, 3, 4, 5, 7, 8]
    assert (records[culled] == 0).all()
    assert (keys[culled] == 0xFFFFFFFF).all()
    frame = render(device, case)
    assert np.isfinite(frame.image.get()).all()
    sums = sum_pixels(device, case, np.ones((3, 30, 40), np.float32), 15, texture=np.ones((30, 40), np.float32))
    assert np.isfinite(sums).all()


def at_45_degrees(rng: np.random.Generator) -> Case:
    """A camera that looks along z at needles in the diagonal of the image, whose variances in x and y are equal."""
    case = random_case(rng, 12, 32, 32, **BOX)
    camera = replace(case.view.camera, fx=40.0, fy=40.0, cx=16.0, cy=16.0)
    view = replace(case.view, camera=camera, world_to_camera=np.eye(3, 4))
    p = {name: table.copy() for name, table in case.parameters.items()}
    p["means"] = np.concatenate([rng.uniform(-0.6, 0.6, (12, 2)), rng.uniform(2, 3, (12, 1))], 1).astype(np.float32)
    p["means"][:, 1] = p["means"][:, 0]  # the perspective keeps the diagonal there
    half = np.pi / 8
    p["quats"][:] = np.float32([np.cos(half), 0, 0, np.sin(half)])
    p["log_scales"] = np.log(rng.uniform(0.005, 0.05, (12, 1)) * [8, 1, 1]).astype(np.float32)
    return replace(case, parameters=p, view=view)


def test_splats_where_the_axes_swap(device, rng):
    """Rounding decides between two lines that agree to 0.5 %."""
    case = at_45_degrees(rng)
    truth = case.project().conic
    assert np.abs(truth[:, 0] - truth[:, 2]).max() < 1e-5 * truth[:, 0].max()
    expected = ref.blend(case.project(), 32, 32, np.array([0.2, 0.5, 0.9], np.float32).astype(np.float64))[0]
    assert np.abs(render(device, case).image.get()[:, :32, :32] - expected).max() < 0.01


def test_round_splats_where_the_axes_swap(device, rng):
    case = random_case(rng, 40, **BOX)
    case.parameters["log_scales"][:] = case.parameters["log_scales"][:, :1]
    assert_within_bounds(check_record(device, case, "round Gaussians"))
    assert_within_bounds(check_blend(device, case, "round Gaussians"))


@on_one_setting
def test_schedules_give_the_same_image(device, rng):
    case = random_case(rng, 200, 70, 50, **BOX)
    case.parameters["log_scales"][:60] -= 2
    image = render(device, case).image.get()
    for schedule, lanes in (("wide", 16), ("wide", 8), ("simt", 1)):
        other = Device(device.info, schedule)
        other.tuning["LANES"] = lanes
        assert_schedules_agree(device, render(other, case).image.get()[:, :50, :70], image[:, :50, :70])


def test_depth_and_alpha(device, rng):
    """What paints other channels blends the same weights."""
    case = random_case(rng, 50, **BOX)
    frame = Rasterizer(device, "radix").forward(
        case.model(device), case.device_camera(device), device.zeros(3), "depth"
    )
    alpha, left = frame.image.get()[1, :30, :40], frame.transmittance.get()[:30, :40]
    np.testing.assert_allclose(alpha, 1 - left, atol=2e-6)
    depth = case.project()
    weights = ref.blend_weights(depth, 40, 30)
    expected = np.einsum("n,nhw->hw", np.where(depth.visible, depth.depth, 0), weights)
    assert np.median(np.abs(frame.image.get()[0, :30, :40] - expected)) < 1e-5
