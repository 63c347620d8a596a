"""box_blur.cl of the examples against NumPy in float64."""

from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.settings import variants
from clsplat.photos.transforms import PhotographTransform
from tests.support.device_images import colors_of, planes_of
from tests.support.devices import each_once, on_devices

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def loaded(without_plugins) -> None:
    """The example as a plug-in."""
    clsplat.load_plugin(EXAMPLES / "box_blur.py")


def window_mean(image: np.ndarray, reach: int) -> np.ndarray:
    """Mean of the window around each pixel, as far as it lies inside the image.  image: [3, H, W]."""
    _, height, width = image.shape
    result = np.empty_like(image)
    for y in range(height):
        for x in range(width):
            window = image[:, max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
            result[:, y, x] = window.mean(axis=(1, 2))
    return result


@on_devices(
    "width, height, reach", each_once([(1, 1), (15, 4), (16, 16), (17, 5), (64, 2), (65, 7)], [0, 0.4, 2.6, 80])
)
def test_box_blur_is_the_window_mean(device, rng, width, height, reach):
    image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    transform = variants(PhotographTransform)["box_blur"](reach=reach)
    colors = colors_of(transform.apply(planes_of(device, image), step=1))
    np.testing.assert_allclose(colors, window_mean(image.astype(np.float64), round(reach)), rtol=1e-5)
