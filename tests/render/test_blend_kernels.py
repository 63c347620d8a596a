"""blend_wide.cl and blend_simt.cl (forward pass) and layer.cl against the reference."""

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import BACKGROUND, check_blend, check_layer, median_depths
from clsplat.conformance.scenes import Case, random_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from tests.support.deviations import assert_schedules_agree, assert_within_bounds
from tests.support.devices import each_once, on_devices, on_one_setting


def render(device: Device, case: Case, sort: str = "radix") -> tuple[np.ndarray, np.ndarray]:
    """Image [3, H, W] and transmittance [H, W]; checks that the planes are zero outside the image."""
    frame = Rasterizer(device, sort).forward(case.model(device), case.device_camera(device), device.upload(BACKGROUND))
    image, transmittance = frame.image.get(), frame.transmittance.get()
    width, height = case.size
    for plane in (*image, transmittance):
        assert (plane[height:] == 0).all()
        assert (plane[:, width:] == 0).all()
    return image[:, :height, :width], transmittance[:height, :width]


def compare(device: Device, case: Case) -> None:
    assert_within_bounds(check_blend(device, case, "the scene"))


@on_devices("width, height", [(64, 48), (15, 17), (16, 16)])
def test_images(device, rng, width, height):
    compare(device, random_case(rng, 120, width, height))


@on_devices("count", [2, 15, 16])
def test_few_splats(device, rng, count):
    compare(device, random_case(rng, count))


def test_median_depths(device, rng):
    assert_within_bounds(median_depths(device, rng))


def test_empty_frame_shows_the_background(device, rng):
    image, transmittance = render(device, random_case(rng, 0))
    assert (image == BACKGROUND[:, None, None]).all()
    assert (transmittance == 1).all()


def test_long_tiles_and_finished_pixels(device, rng):
    """More splats in a tile than any batch holds, opaque enough that pixels finish early."""
    case = random_case(rng, 700, 32, 20)
    case.parameters["log_scales"] += 0.7
    case.parameters["logit_opacity"] += 1.5
    _, transmittance = render(device, case)
    assert (transmittance < 2e-4).mean() > 0.5
    compare(device, case)


@on_one_setting
def test_sorts_give_the_same_bits(device, rng):
    case = random_case(rng, 300, 70, 50)
    for radix, bitonic in zip(render(device, case, "radix"), render(device, case, "bitonic"), strict=True):
        np.testing.assert_array_equal(radix, bitonic)


@on_one_setting
def test_order_in_memory_does_not_matter(device, rng):
    case = random_case(rng, 200, 50, 40)
    shuffled = rng.permutation(200)
    other = Case({name: table[shuffled] for name, table in case.parameters.items()}, case.view)
    for a, b in zip(render(device, case), render(device, other), strict=True):
        np.testing.assert_array_equal(a, b)


@on_one_setting
def test_schedules_give_the_same_image(device, rng):
    """On one device the image does not depend on how the work is cut."""
    case = random_case(rng, 400, 90, 70)
    case.parameters["logit_opacity"] += 1
    image, transmittance = render(device, case)
    for schedule, lanes in (("wide", 16), ("wide", 8), ("simt", 1)):
        other = Device(device.info, schedule)
        other.tuning["LANES"] = lanes
        for a, b in zip(render(other, case), (image, transmittance), strict=True):
            assert_schedules_agree(device, a, b)


@on_devices("count", [0, 1, 15, 16, 17, 65, 150])
def test_depth_and_alpha_are_sums_of_blend_weights(device, rng, count):
    case = random_case(rng, count, 48, 32)
    model, camera = case.model(device), case.device_camera(device)
    frame = Rasterizer(device).forward(model, camera, device.zeros(3), "depth")
    image = frame.image.get()[:, : camera.height, : camera.width].astype(np.float64)
    pose = case.camera().world_to_camera
    depth = case.parameters["means"].astype(np.float64) @ pose[2, :3] + pose[2, 3]
    weights = ref.blend_weights(case.project(), 48, 32) if count else np.zeros((0, 32, 48))
    np.testing.assert_allclose(
        image[0], np.tensordot(depth, weights, 1), atol=2e-4 * max(1, np.abs(depth).max(initial=0))
    )
    np.testing.assert_allclose(image[1], weights.sum(axis=0), atol=2e-4)


@on_one_setting
def test_depth_in_bands_is_the_same(device, rng):
    from clsplat.render.rasterizer import RenderLimits

    case = random_case(rng, 120, 48, 64)
    model, camera = case.model(device), case.device_camera(device)
    whole, banded = (
        Rasterizer(device, budget=budget).forward(model, camera, device.zeros(3), "depth").image.get()
        for budget in (None, RenderLimits(60))
    )
    np.testing.assert_array_equal(whole, banded)


@on_devices(
    "width, height, channels",
    each_once([(1, 1), (15, 3), (16, 16), (17, 5), (33, 18), (65, 2), (129, 17)], [3, 4]),
)
def test_both_the_loss_and_the_derivatives(device, rng, width, height, channels):
    assert_within_bounds(check_layer(device, rng, width, height, channels))
