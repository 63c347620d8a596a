"""blur.cl against the reference."""

import math

import numpy as np
import pytest

from clsplat.conformance.reference import blur
from clsplat.conformance.reference.images import masked_mean
from clsplat.core.schedule import at_step
from clsplat.photos.transforms import Blur, MeanFilter
from clsplat.pipeline.loading import load
from clsplat.stages.optimize import Optimize
from tests.support.device_images import colors_of, planes_of
from tests.support.devices import each_once, on_devices, product

SIZES = ((1, 1), (2, 3), (15, 4), (16, 16), (17, 5), (33, 18), (63, 3), (64, 2), (65, 7))  # tiles and groups


@on_devices("width, height, sigma, share", each_once(SIZES, product([0.3, 1.0, 2.5, 200.0], [None, 0.7, 0.05])))
def test_blur_matches_the_reference(device, rng, width, height, sigma, share):
    image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    mask = None if share is None else rng.random((height, width)) < share
    colors = colors_of(Blur(sigma=sigma).apply(planes_of(device, image, mask), step=1))
    np.testing.assert_allclose(colors, blur(image.astype(np.float64), sigma, mask), rtol=2e-5, atol=1e-6)


def test_pixel_without_counted_neighbors_is_unchanged(device, rng):
    image = rng.uniform(0, 1, (3, 20, 40)).astype(np.float32)
    mask = np.zeros((20, 40), bool)
    mask[10, 5] = True
    colors = colors_of(Blur(sigma=1.0).apply(planes_of(device, image, mask), step=1))
    near = np.zeros((20, 40), bool)
    near[7:14, 2:9] = True
    np.testing.assert_array_equal(colors[:, ~near], image[:, ~near])
    np.testing.assert_allclose(colors[:, near], np.broadcast_to(image[:, 10, 5, None], (3, 49)), rtol=1e-6)


@on_devices("masked", [False, True])
def test_neither_the_edge_nor_a_mask_darkens_a_flat_image(device, rng, masked):
    image = np.full((3, 18, 33), 0.75, np.float32)
    mask = rng.random((18, 33)) < 0.5 if masked else None
    if mask is not None:
        image[:, ~mask] = 0
    colors = colors_of(Blur(sigma=4.0).apply(planes_of(device, image, mask), step=1))
    np.testing.assert_allclose(colors, 0.75, rtol=1e-6)


def test_zero_sigma_leaves_the_image(device, rng):
    image = rng.uniform(0, 1, (3, 5, 9)).astype(np.float32)
    transform = Blur(sigma={"points": [[0, 0.0], [10, 2.0]], "between": "steps"})
    np.testing.assert_array_equal(colors_of(transform.apply(planes_of(device, image), step=9)), image)
    expected = blur(image.astype(np.float64), 2.0)
    np.testing.assert_allclose(colors_of(transform.apply(planes_of(device, image), step=10)), expected, rtol=2e-5)


@on_devices(
    "share, reach, masked",
    each_once([(0.0, 0), (0.09, 0), (0.1, 1), (0.24, 2), (0.25, 2), (0.5, 5), (3.0, 30)], [False, True]),
)
def test_mean_filter_matches_the_reference(device, rng, share, reach, masked):
    image = rng.uniform(0, 1, (3, 17, 20)).astype(np.float32)
    mask = rng.random((17, 20)) < 0.5 if masked else None
    colors = colors_of(MeanFilter(width=share).apply(planes_of(device, image, mask), step=1))
    if reach == 0:
        np.testing.assert_array_equal(colors, image)
    np.testing.assert_allclose(colors, masked_mean(image.astype(np.float64), reach, 0.0, mask), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize(("recipe", "end"), [("opti3dgs", 12000), ("opti3dgs_7k", 2800)])
def test_opti3dgs_squares_shrink_by_a_pixel_a_side_to_the_end(recipe, end):
    """15, 13, … 1 px at 1 237 px, the width of the paper's photographs, each as long as the others."""
    (training,) = (stage for stage in load(recipe).stages if isinstance(stage, Optimize))
    (filtering,) = training.views.transforms
    reaches = [math.floor(at_step(filtering.width, step) * 1237 / 2) for step in range(end + 1)]
    changes = [step for step in range(1, end + 1) if reaches[step] != reaches[step - 1]]
    assert [reaches[0], *(reaches[step] for step in changes)] == [7, 6, 5, 4, 3, 2, 1, 0]
    assert changes == [round(end * k / 7) for k in range(1, 8)]
