"""Bands of tiles and short launches: the same bits as all at once."""

import numpy as np
import pytest

from clsplat.render.rasterizer import MAX_PAIRS, Budget, Rasterizer
from tests.scenes import random_case


def results(device, case, weights, budget=None, sort="radix"):
    rasterizer, model, camera = Rasterizer(device, sort, budget), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(np.array([0.2, 0.5, 0.9], np.float32)))
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    image = frame.image.get()
    pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(planes)).get()[:, : model.gaussians.count]
    return image, pixel_sums, frame


@pytest.mark.parametrize("sort", ["radix", "bitonic"])
@pytest.mark.parametrize(
    ("budget", "bands"),
    [(Budget(MAX_PAIRS), 1), (Budget(600), 2), (Budget(250), 4), (Budget(1), 5), (Budget(MAX_PAIRS, 3), 1),
     (Budget(1, 1), 5), (Budget(250, 1000), 4)],
)  # fmt: skip
def test_image_and_sums_over_pixels_are_the_same_bits(device, rng, budget, bands, sort):
    case = random_case(rng, 300, 60, 70)
    case.parameters["log_scales"][:20] += 1.5  # some over many rows of tiles, and too many tiles for a mask
    weights = rng.normal(size=(3, 70, 60)).astype(np.float32)
    image, pixel_sums, frame = results(device, case, weights)
    assert frame.lists.pairs > 600
    banded_image, banded_sums, banded = results(device, case, weights, budget, sort)
    if device.tuning["TILE"] == 16 and bands in (1, 5):
        assert len(banded.bands) == bands
    assert (len(banded.bands) > 1) == (bands > 1)
    np.testing.assert_array_equal(banded_image, image)
    np.testing.assert_array_equal(banded_sums, pixel_sums)


def test_nothing_in_a_band(device, rng):
    case = random_case(rng, 0, 40, 64)
    image, _, _ = results(device, case, 0.0, Budget(1, 2))
    np.testing.assert_allclose(image[:, :64, :40], np.broadcast_to([[[0.2]], [[0.5]], [[0.9]]], (3, 64, 40)), rtol=1e-6)
