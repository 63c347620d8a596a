"""project.cl against the float64 oracle."""

import numpy as np
import pytest

from clsplat.render.camera import CAMERA
from clsplat.render.rasterizer import PIXEL_SUMS, RECORD, Rasterizer
from tests import reference as ref
from tests.scenes import Case, random_case, relative_error, with_world_filter

COUNTS = (1, 7, 8, 9, 15, 16, 17, 63, 64, 65, 200)
TOLERANCE = 2e-5  # float32, about 300 operations, determinants that cancel


def splats_of(device, case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records [N, RECORD], depth keys [N] and radii [N] of the kernel."""
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    keys = rasterizer.workspace.array("depth_key", len(case.parameters["means"]), np.uint32).get()
    return frame.splats.get(), keys, frame.radius.get()[: len(keys)]


def compare(device, case: Case) -> None:
    records, keys, radius = splats_of(device, case)
    truth = case.project()
    width, height = case.size
    # the kernel also drops what no pixel of the image can see: those must be outside or too faint
    drawn = records[:, 5] > 0
    assert not (drawn & ~truth.visible).any()
    for n in np.flatnonzero(truth.visible & ~drawn):
        x, y = truth.mean2d[n]
        assert x < 0 or y < 0 or x > width or y > height or truth.opacity[n] < 1.001 / 255
    np.testing.assert_allclose(records[drawn, :2], truth.mean2d[drawn], rtol=TOLERANCE, atol=1e-3)
    for n in np.flatnonzero(drawn):
        assert relative_error(records[n, 2:5], truth.conic[n]) < 1e-4, n
    np.testing.assert_allclose(records[drawn, 5], truth.opacity[drawn], rtol=TOLERANCE)
    np.testing.assert_allclose(records[drawn, 6:9], truth.colour[drawn], rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(keys[drawn].view(np.float32), truth.depth[drawn], rtol=1e-6)
    assert (keys[~drawn] == 0xFFFFFFFF).all()
    assert (records[~drawn] == 0).all()
    # ceil() may jump by a pixel where the radius is almost whole
    assert (np.abs(radius - truth.radius) <= 1).all()
    assert np.mean(radius != truth.radius) < 0.02
    # extents: where alpha falls to 1/255, and a little more
    reach2 = 2 * np.log(255 * truth.opacity[drawn])
    a, b, c = truth.conic[drawn].T
    half_x, half_y = np.sqrt(reach2 * c / (a * c - b * b)), np.sqrt(reach2 * a / (a * c - b * b))
    for low, high, centre, half in ((11, 12, 0, half_x), (9, 10, 1, half_y)):
        assert (records[drawn, high] >= truth.mean2d[drawn, centre] + half - 1e-3).all()
        assert (records[drawn, low] <= truth.mean2d[drawn, centre] - half + 1e-3).all()
        assert (records[drawn, high] - records[drawn, low] <= 2.4 * half + 1).all()


@pytest.mark.parametrize("count", COUNTS)
def test_records_at_group_edges(device, rng, count):
    compare(device, random_case(rng, count))


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_degrees(device, rng, degree):
    compare(device, random_case(rng, 50, degree=degree))


@pytest.mark.parametrize(("variance", "compensate"), [(0.3, 0.0), (0.3, 1.0), (0.1, 1.0), (0.0, 0.0)])
def test_filters(device, rng, variance, compensate):
    compare(device, with_world_filter(random_case(rng, 60, variance=variance, compensate=compensate), rng))


def test_nothing_to_project(device, rng):
    records, keys, _ = splats_of(device, random_case(rng, 0))
    assert records.shape == (0, RECORD)
    assert keys.shape == (0,)


def test_what_cannot_be_drawn_is_culled(device, rng):
    case = random_case(rng, 40)
    p = case.parameters
    behind = (np.array([0, 0, -3]) - case.view.world_to_camera[:, 3]) @ case.view.world_to_camera[:, :3]
    p["means"][0] = behind
    p["means"][1, 1] = np.nan
    p["means"][2] = 1e30
    p["quats"][3] = 0
    p["quats"][4, 2] = np.nan
    p["log_scales"][5] = np.nan
    p["log_scales"][6] = 200  # clamped, covers everything
    p["logit_opacity"][7] = -9
    p["logit_opacity"][8] = np.nan
    records, keys, radius = splats_of(device, case)
    for n in (0, 1, 2, 3, 4, 5, 7, 8):
        assert (records[n] == 0).all(), n
        assert keys[n] == 0xFFFFFFFF
    assert (radius[:6] == 0).all()
    assert np.isfinite(records).all() or not np.isnan(records).any()
    compare(device, Case({k: v[9:] for k, v in p.items()}, case.view))


def test_camera_struct_has_the_kernels_layout(device):
    assert CAMERA.itemsize == 4 * 27
    assert all(CAMERA.fields[name][1] % 4 == 0 for name in CAMERA.names)


def backward_case(device, rng, case: Case) -> None:
    """Feed both sides the same sums of a Gaussian's pixels."""
    model, camera = case.model(device), case.device_camera(device)
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(model, camera, device.zeros(3))
    gaussians = model.gaussians
    truth = case.project()
    drawn = frame.splats.get()[:, 5] > 0
    pixel_sums = np.zeros((PIXEL_SUMS, gaussians.capacity), np.float32)
    pixel_sums[:, : gaussians.count] = rng.normal(size=(PIXEL_SUMS, gaussians.count)) * drawn
    gradients = rasterizer.gradients(model, frame, device.upload(pixel_sums))
    m = pixel_sums[:, : gaussians.count].astype(np.float64).T
    a, b, c = truth.conic.T
    grad_mean2d = -np.stack([a * m[:, 1] + b * m[:, 2], b * m[:, 1] + c * m[:, 2]], axis=1)
    grad_conic = np.stack([-0.5 * m[:, 3], -m[:, 4], -0.5 * m[:, 5]], axis=1)
    grad_opacity = np.where(drawn, m[:, 0] / np.where(drawn, truth.opacity, 1), 0)
    expected = ref.project_backward(
        case.gaussians(),
        case.camera(),
        case.degree,
        case.variance,
        case.compensate,
        truth,
        grad_mean2d,
        grad_conic,
        grad_opacity,
        m[:, 6:9],
    )
    expected["sh_base"] = expected["sh"][:, 0]
    expected["sh_rest"] = expected.pop("sh")[:, 1:].reshape(gaussians.count, -1)
    expected["logit_opacity"] = expected["logit_opacity"][:, None]
    for name, array in gradients.arrays.items():
        value = array.get()[:, : gaussians.count].T
        assert relative_error(value, expected[name]) < 1e-4, name
    assert relative_error(gradients.mean2d.get()[:, : gaussians.count].T, grad_mean2d) < 1e-4


@pytest.mark.parametrize("count", COUNTS)
def test_gradients_at_group_edges(device, rng, count):
    backward_case(device, rng, random_case(rng, count))


@pytest.mark.parametrize("degree", range(4))
def test_gradients_of_harmonics(device, rng, degree):
    backward_case(device, rng, random_case(rng, 40, degree=degree))


@pytest.mark.parametrize(("variance", "compensate"), [(0.3, 1.0), (0.1, 1.0), (0.3, 0.0)])
def test_gradients_through_the_filters(device, rng, variance, compensate):
    backward_case(device, rng, with_world_filter(random_case(rng, 60, variance=variance, compensate=compensate), rng))


def test_gradients_where_the_ray_is_clamped(device, rng):
    case = random_case(rng, 30)
    depth, far = rng.uniform(1, 2, 30), rng.choice([-1, 1], 30) * rng.uniform(0.9, 1.3, 30)
    in_camera = np.stack([far * depth, 0.2 * depth, depth], axis=1)
    rotation, translation = case.view.world_to_camera[:, :3], case.view.world_to_camera[:, 3]
    case.parameters["means"][:] = (in_camera - translation) @ rotation
    case.parameters["log_scales"][:] = np.log(0.6) + rng.normal(0, 0.2, (30, 3))
    limits = case.device_camera(device).array.get()[0]
    assert (np.abs(far) > limits["ray_x_max"]).any()
    backward_case(device, rng, case)
