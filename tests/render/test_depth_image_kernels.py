"""Depth in the place of colour, against the oracle's blend weights."""

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.render.rasterizer import Rasterizer


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 65, 150])
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
    assert not image[2].any()


def test_depth_in_bands_is_the_same(device, rng):
    from clsplat.render.rasterizer import Budget

    case = random_case(rng, 120, 48, 64)
    model, camera = case.model(device), case.device_camera(device)
    whole, banded = (
        Rasterizer(device, budget=budget).forward(model, camera, device.zeros(3), "depth").image.get()
        for budget in (None, Budget(60))
    )
    np.testing.assert_array_equal(whole, banded)
