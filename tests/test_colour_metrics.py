"""Figures in the colours of the photographs, beside PSNR."""

import numpy as np
import pytest

from clsplat.metrics.colours import colour_figures, corrected_by_regression, in_colours_of
from clsplat.metrics.images import MAX_PSNR, psnr, to_8_bits
from clsplat.views.colours import Affine, Gain

GAINS = np.array([1.3, 0.9, 1.1])


@pytest.fixture
def image(rng) -> np.ndarray:
    return rng.uniform(0.05, 0.7, (20, 31, 3)).astype(np.float32)


def everywhere(image: np.ndarray) -> np.ndarray:
    return np.ones(image.shape[:2], bool)


def test_an_exposure_costs_psnr_and_nothing_in_the_colours_of_the_photograph(image):
    photograph = to_8_bits(image * GAINS.astype(np.float32))
    assert psnr(image, photograph) < 25
    found = colour_figures(image, photograph, None, Gain())
    assert found["psnr_colour"] > 50
    assert found["psnr_affine"] > 50


def test_equal_images_stay_equal(image):
    photograph = to_8_bits(image)
    for model in (Gain(), Affine()):
        assert colour_figures(photograph / np.float32(255), photograph, None, model)["psnr_colour"] == MAX_PSNR


def test_no_pixel_is_measured_in_colours_that_were_fitted_to_it(image):
    """What is true of one half alone does not help there."""
    photograph = to_8_bits(image)
    photograph[:, :15] = to_8_bits(image[:, :15] * 0.5)
    changed = in_colours_of(image.astype(np.float64), photograph, everywhere(image), Gain())
    assert changed[:, :15] == pytest.approx(image[:, :15], abs=0.01), "as the right half asks for"
    assert changed[:, 15:] == pytest.approx(0.5 * image[:, 15:], abs=0.01)


def test_white_black_and_masked_pixels_say_nothing_of_colours(image, rng):
    truth = np.minimum(image * 1.5, 1)
    photograph, counted = to_8_bits(truth), rng.random(image.shape[:2]) < 0.8
    assert (photograph == 255).any()
    photograph[~counted] = 128
    changed = in_colours_of(image.astype(np.float64), photograph, counted, Gain())
    assert changed[counted] == pytest.approx(truth[counted], abs=0.01)
    nothing = np.zeros(image.shape[:2], bool)
    assert in_colours_of(image.astype(np.float64), photograph, nothing, Affine()) == pytest.approx(image)


def test_the_regression_is_of_the_image_on_the_photograph(rng):
    """With noise in the image its slope is too small by nothing, with noise in the photograph by 1 / (1 + noise)."""
    truth = rng.uniform(0.2, 0.8, (60, 60, 3))
    image = 0.5 * truth + 0.1
    assert corrected_by_regression(image, truth, everywhere(image)) == pytest.approx(truth)
    flat = np.full_like(truth, 0.3)
    assert corrected_by_regression(flat, truth, everywhere(flat)) == pytest.approx(flat)
