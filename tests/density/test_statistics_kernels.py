"""The statistics that density rules read, from pixel sums to decisions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import relative_error
from clsplat.conformance.scenes import Case, add_world_filter, random_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import ABS_X, SEEN, WEIGHT, SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.losses.base import ViewGradients
from clsplat.methods.adc import Clone, PruneFaint, SplitLarge
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from tests.support.devices import on_devices, on_one_setting, product

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)
ALL = ABS_X + 2


def pixel_sums_of(device: Device, case: Case, weights: np.ndarray, count: int) -> np.ndarray:
    """Sums over each Gaussian's pixels under the loss Σ weights · image, [N, count]."""
    rasterizer, model, camera = Rasterizer(device, "radix"), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    return rasterizer.pixel_sums(model, frame, device.upload(planes), count).get()[:, : model.gaussians.count].T


def expected_abs(case: Case, weights: np.ndarray) -> np.ndarray:
    """Sums over pixels of |dL/du| and |dL/dv|, [N, 2]."""
    splats = case.project()
    return ref.blend_backward(splats, *case.size, BACKGROUND.astype(np.float64), weights).mean2d_abs


@on_devices("count, width, height", [(0, 16, 16), (1, 16, 16), (17, 33, 15), (40, 40, 30), (65, 24, 24)])
def test_absolute_gradients(device, rng, count, width, height):
    case = add_world_filter(random_case(rng, count, width, height, variance=0.1, compensate=1.0), rng)
    weights = rng.normal(size=(3, height, width)).astype(np.float32)
    pixel_sums = pixel_sums_of(device, case, weights, ALL)
    assert relative_error(pixel_sums[:, ABS_X:], expected_abs(case, weights)) < 2e-3  # pixels at thresholds
    assert relative_error(pixel_sums[:, :PIXEL_SUMS], pixel_sums_of(device, case, weights, PIXEL_SUMS)) < 1e-6


@on_one_setting
def test_schedules_agree(device, rng):
    case = random_case(rng, 400, 90, 70)
    weights = rng.normal(size=(3, 70, 90)).astype(np.float32)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    mine, theirs = pixel_sums_of(device, case, weights, ALL), pixel_sums_of(other, case, weights, ALL)
    assert relative_error(mine[:, ABS_X:], theirs[:, ABS_X:]) < 1e-6


def test_absolute_sums_do_not_cancel(device):
    """A wide splat under a loss that pulls its left half left and its right half right."""
    rng = np.random.default_rng(0)
    case = random_case(rng, 1, 48, 48)
    pose = np.eye(4)[:3]
    camera = replace(case.view.camera, fx=40.0, fy=40.0, cx=24.0, cy=24.0)
    case = replace(case, view=replace(case.view, world_to_camera=pose, camera=camera), degree=0)
    p = case.parameters
    p["means"][:], p["log_scales"][:], p["logit_opacity"][:] = (0, 0, 4), np.log(0.5), 0
    p["quats"][:] = (1, 0, 0, 0)
    weights = np.zeros((3, 48, 48), np.float32)
    weights[:, :, :] = np.where(np.abs(np.arange(48) - 23.5) > 6, 1, -1)  # symmetric: the halves pull apart
    pixel_sums = pixel_sums_of(device, case, weights, ALL)[0].astype(np.float64)
    assert abs(pixel_sums[1]) < 1e-4 * pixel_sums[ABS_X]
    np.testing.assert_allclose(pixel_sums[ABS_X:], expected_abs(case, weights)[0], rtol=2e-3)


OF_GRADIENTS = ("screen_grad", "screen_grad_abs", "screen_grad_abs_sum")


@on_devices("names", product([(), ("screen_grad",), OF_GRADIENTS]))
def test_columns(device, rng, names):
    case = random_case(rng, 65)
    case.parameters["means"][::4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    model = case.model(device)
    frame = Rasterizer(device, "radix").forward(model, case.device_camera(device), device.zeros(3))
    gaussians, (width, height) = model.gaussians, case.size
    stats = SplatStats(gaussians, names)
    assert stats.pixel_sums == (ALL if len(names) > 1 else PIXEL_SUMS)
    planes = rng.normal(size=(ALL, gaussians.capacity)).astype(np.float32)
    planes[ABS_X:] = np.abs(planes[ABS_X:])
    view = ViewGradients(frame, None, [], device.upload(planes))
    for _ in range(2):
        stats.add(view, device.upload(planes[:2]))
    visible = frame.radius.get()[:65] > 0
    assert 0 < visible.sum() < 65
    half = np.array([width / 2, height / 2])
    expected = {
        "screen_grad": ref.screen_gradient(planes[:2, :65].T.astype(np.float64), width, height),
        "screen_grad_abs": ref.screen_gradient(planes[ABS_X:, :65].T.astype(np.float64), width, height),
        "screen_grad_abs_sum": planes[ABS_X:, :65].T.astype(np.float64) @ half,
    }
    for name in names:
        np.testing.assert_allclose(gaussians.get(f"stats/{name}")[:, 0], 2 * expected[name] * visible, rtol=1e-5)
        np.testing.assert_allclose(stats.mean(name), expected[name] * visible, rtol=1e-5)
    np.testing.assert_array_equal(gaussians.get(SEEN)[:, 0], 2 * visible)
    stats.clear()
    assert not any(gaussians.get(f"stats/{name}").any() for name in (*names, "seen"))


@on_one_setting
def test_added_and_removed_columns_keep_their_sums(device, rng):
    gaussians = random_case(rng, 20).model(device).gaussians
    stats = SplatStats(gaussians, ["screen_grad"])
    gaussians["stats/screen_grad"].fill(3)
    stats = SplatStats(gaussians, ["screen_grad", "screen_grad_abs"])
    assert (gaussians.get("stats/screen_grad") == 3).all()
    stats = SplatStats(gaussians, ["screen_grad_abs"])
    assert stats.names == ("screen_grad_abs",)
    assert "stats/screen_grad" not in gaussians.tables


def row_counts(
    device: Device, screen_grad: list[float], absolute: list[float], size: list[float], rules: list
) -> list[int]:
    """Rows that each Gaussian becomes under `rules`, from means of its statistics and its size."""
    count = len(size)
    case = random_case(np.random.default_rng(1), count)
    case.parameters["log_scales"][:] = np.log(np.array(size))[:, None]
    case.parameters["logit_opacity"][:] = 0
    case.parameters["sh_base"][:, 0] = np.arange(count)
    gaussians = case.model(device).gaussians
    stats = SplatStats(gaussians, {name for rule in rules for name in rule.statistics})
    gaussians.set(SEEN, np.full((count, 1), 2.0))
    for name, means in (("screen_grad", screen_grad), ("screen_grad_abs", absolute), ("screen_grad_abs_sum", absolute)):
        if name in stats.names:
            gaussians.set(f"stats/{name}", 2 * np.array(means)[:, None])
    densify(Edit(gaussians, stats, SceneScale(1.0), step=600, seed=0), rules, Rasterizer(device, "radix").tiler)
    return np.bincount(gaussians.get("sh_base")[:, 0].astype(int), minlength=count).tolist()


@on_one_setting
def test_absgs_splits_where_gradients_cancel(device):
    """Clone by the ordinary gradient, split by the absolute one, divided at 0.001 of the extent."""
    rules = [
        Clone(gradient_above=2e-4, size_below=0.001),
        SplitLarge(statistic="screen_grad_abs", gradient_above=4e-4, size_above=0.001),
        PruneFaint(),
    ]
    cases = [
        (3e-4, 3e-4, 0.0005, 2),  # small and pulled: cloned
        (1e-4, 9e-4, 0.0005, 1),  # small, its gradients cancel: stays
        (1e-4, 9e-4, 0.02, 2),  # large, its gradients cancel: split, which the ordinary gradient would not do
        (3e-4, 3e-4, 0.02, 1),  # large, but the absolute gradient is below its own threshold
        (3e-4, 5e-4, 0.002, 2),
    ]
    grad, absolute, size, rows = (list(column) for column in zip(*cases, strict=True))
    assert row_counts(device, grad, absolute, size, rules) == rows
    rule = ref.DensityConstants(split_gradient=4e-4, dense=0.001)
    oracle = ref.adc_actions(np.array(grad), np.array(size), np.full(5, 0.5), 1.0, False, rule, np.array(absolute))
    assert [1 + (action in (ref.CLONE, ref.SPLIT)) for action in oracle] == rows


@on_one_setting
def test_as_many_as_selects_the_matching_quantile(device):
    """Two of eight reach the ordinary threshold, so the two or so largest absolute gradients qualify as well."""
    grad = [9e-4, 5e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]
    absolute = [1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3, 7e-3, 8e-3]
    clone = Clone(gradient_above=2e-4, size_below=1)
    matching = Clone(statistic="screen_grad_abs_sum", as_many_as="screen_grad", gradient_above=2e-4, size_below=1)
    assert row_counts(device, grad, absolute, [0.1] * 8, [clone]) == [2, 2, 1, 1, 1, 1, 1, 1]
    limit = np.quantile(absolute, 0.75)
    assert [value >= limit for value in absolute[-3:]] == [False, True, True]
    assert row_counts(device, grad, absolute, [0.1] * 8, [clone, matching]) == [2, 2, 1, 1, 1, 1, 2, 2]


@on_one_setting
def test_as_many_as_never_selects_zero_gradients(device):
    """If so many qualify that the quantile is zero, a Gaussian without gradient still does not."""
    grad, absolute = [9e-4, 9e-4, 9e-4, 0.0], [0.0, 0.0, 0.0, 1e-3]
    matching = Clone(statistic="screen_grad_abs_sum", as_many_as="screen_grad", gradient_above=2e-4, size_below=1)
    assert row_counts(device, grad, absolute, [0.1] * 4, [matching]) == [1, 1, 1, 2]


def test_texture_under_splats(device, rng):
    """Σ w texture / Σ w against the oracle's blend weights; the other sums stay as they are."""
    case = random_case(rng, 40, 48, 32)
    rasterizer, model, camera = Rasterizer(device, "radix"), case.model(device), case.device_camera(device)
    texture = np.zeros((camera.rows, camera.stride), np.float32)
    texture[:32, :48] = np.where(rng.random((32, 48)) < 0.9, rng.uniform(0, 0.5, (32, 48)), -1)  # a tenth is masked
    weights = np.zeros((3, camera.rows, camera.stride), np.float32)
    weights[:, :32, :48] = rng.normal(size=(3, 32, 48))
    frame = rasterizer.forward(model, camera, device.zeros(3))
    planes = device.upload(weights)
    few = rasterizer.pixel_sums(model, frame, planes).get()[:, :40]
    pixel_sums = rasterizer.pixel_sums(model, frame, planes, WEIGHT + 2, device.upload(texture))
    assert relative_error(pixel_sums.get()[:PIXEL_SUMS, :40], few) < 1e-6
    blended = ref.blend_weights(case.project(), 48, 32)
    blended *= texture[:32, :48] >= 0
    weight, textured = blended.sum(axis=(1, 2)), (blended * texture[:32, :48]).sum(axis=(1, 2))
    assert relative_error(pixel_sums.get()[WEIGHT, :40], weight) < 1e-3  # pixels at thresholds
    assert relative_error(pixel_sums.get()[WEIGHT + 1, :40], textured) < 1e-3

    stats = SplatStats(model.gaussians, ["texture", "screen_radius"])
    for _ in range(3):
        stats.add(ViewGradients(frame, None, [], pixel_sums), device.zeros((2, model.gaussians.capacity)))
    seen = (frame.radius.get()[:40] > 0) & (weight > 0.1)
    assert seen.sum() > 10
    np.testing.assert_allclose(stats.mean("texture")[seen], textured[seen] / weight[seen], rtol=5e-3)
    np.testing.assert_allclose(stats.mean("screen_radius"), frame.radius.get()[:40], rtol=1e-6)
    assert stats.pixel_sums == WEIGHT + 2


@on_one_setting
def test_texture_counts_views_by_their_weight(device, rng):
    """A view that hides a Gaussian says nothing of its texture, one that shows little says little."""
    model = random_case(rng, 3).model(device)
    capacity = model.gaussians.capacity
    stats = SplatStats(model.gaussians, ["texture"])
    for weights, textures in (((3.0, 2.0, 0.0), (0.2, 0.1, 0.0)), ((0.0, 6.0, 0.0), (0.0, 0.5, 0.0))):
        pixel_sums, radius = np.zeros((WEIGHT + 2, capacity)), np.zeros(capacity)
        pixel_sums[WEIGHT, :3], pixel_sums[WEIGHT + 1, :3], radius[:3] = weights, np.multiply(weights, textures), 5
        frame = SimpleNamespace(
            radius=device.upload(radius.astype(np.float32)), camera=SimpleNamespace(width=1, height=1)
        )
        view = ViewGradients(frame, None, [], device.upload(pixel_sums.astype(np.float32)))
        stats.add(view, device.zeros((2, capacity)))
    np.testing.assert_allclose(stats.mean("texture"), [0.2, 0.4, 0.0], rtol=1e-6)
