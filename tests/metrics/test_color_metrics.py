"""Metrics in the colors of the photographs, in addition to PSNR."""

import re

import numpy as np
import pytest

from clsplat.metrics.images import MAX_PSNR, psnr, to_8_bits
from clsplat.metrics.views import (
    PIXELS_PER_PARAMETER,
    color_metrics,
    correct_by_regression,
    fit_colors,
    log_color_metrics,
    mean_color_metrics,
)
from clsplat.stages.optimize import comparable_psnr
from clsplat.training.modules.exposure import Affine, Gain

GAINS = np.array([1.3, 0.9, 1.1])


@pytest.fixture
def image(rng) -> np.ndarray:
    return rng.uniform(0.05, 0.7, (20, 31, 3)).astype(np.float32)


def all_pixels(image: np.ndarray) -> np.ndarray:
    return np.ones(image.shape[:2], bool)


def test_exposure_costs_psnr_but_nothing_in_photograph_colors(image):
    photograph = to_8_bits(image * GAINS.astype(np.float32))
    assert psnr(image, photograph) < 25
    result = color_metrics(image, photograph, None, Gain())
    assert result["psnr_color"] > 50
    assert result["psnr_affine"] > 50


def test_equal_images_stay_equal(image):
    photograph = to_8_bits(image)
    for model in (Gain(), Affine()):
        assert color_metrics(photograph / np.float32(255), photograph, None, model)["psnr_color"] == MAX_PSNR


def test_colors_are_fitted_on_other_pixels_than_measured(image):
    """What is true of one half alone does not help there."""
    photograph = to_8_bits(image)
    photograph[:, :15] = to_8_bits(image[:, :15] * 0.5)
    changed = fit_colors(image.astype(np.float64), photograph, all_pixels(image), Gain())
    assert changed[:, :15] == pytest.approx(image[:, :15], abs=0.01), "as the right half asks for"
    assert changed[:, 15:] == pytest.approx(0.5 * image[:, 15:], abs=0.01)


def test_white_black_and_masked_pixels_are_not_fitted(image, rng):
    truth = np.minimum(image * 1.5, 1)
    photograph, counted = to_8_bits(truth), rng.random(image.shape[:2]) < 0.8
    assert (photograph == 255).any()
    photograph[~counted] = 128
    changed = fit_colors(image.astype(np.float64), photograph, counted, Gain())
    assert changed[counted] == pytest.approx(truth[counted], abs=0.01)


@pytest.mark.parametrize(("model", "numbers"), [(Gain(), 1), (Affine(), 4)])
@pytest.mark.parametrize("half", [np.s_[:, :15], np.s_[:, 15:]])
def test_half_with_too_few_pixels_has_no_color_metric(image, model, numbers, half):
    photograph, counted = to_8_bits(image), all_pixels(image)
    counted[half] = False
    rows, columns = np.nonzero(~counted)
    for number, has in ((PIXELS_PER_PARAMETER * numbers - 1, False), (PIXELS_PER_PARAMETER * numbers, True)):
        counted[rows[:number], columns[:number]] = True
        result = color_metrics(image, photograph, counted, model)
        assert ("psnr_color" in result) == has
        assert "psnr_affine" in result


@pytest.mark.parametrize("model", [Gain(), Affine()])
def test_views_with_the_metric_do_not_depend_on_the_model(image, model):
    """Else two steps are compared on different views.  A picture that is white everywhere is bad in any colors."""
    photograph = to_8_bits(0.5 * image)
    for step in (image, image + 2, np.ones_like(image), np.full_like(image, np.inf), np.full_like(image, np.nan)):
        assert "psnr_color" in color_metrics(step, photograph, None, model)
    assert color_metrics(np.ones_like(image), photograph, None, model)["psnr_color"] < 22, "one color"
    bright = color_metrics(image / 0.05, to_8_bits(image), None, model)
    assert bright["psnr_color"] > 50, "beyond white a picture still says which colors it asks for"


def test_pixels_beyond_white_are_dropped_where_enough_remain(image):
    photograph, bright = to_8_bits(0.5 * image), image.astype(np.float64)
    bright[:5] = 3
    changed = fit_colors(bright, photograph, all_pixels(image), Gain())
    assert changed[5:] == pytest.approx(0.5 * image[5:], abs=0.01)


def test_mean_reports_its_number_of_views():
    both, first = {"psnr_color": 30.0, "psnr_affine": 32.0}, {"psnr_affine": 20.0}
    assert mean_color_metrics([both, both]) == both
    assert mean_color_metrics([{}, {}]) == {}
    assert mean_color_metrics([both, first]) == {
        "psnr_color": 30.0,
        "psnr_affine": 26.0,
        "psnr_color_views": 1,
        "psnr_color_reason": "1 of 2 views have a half with too few pixels to fit colors to",
    }
    none = mean_color_metrics([first])
    assert (none["psnr_color"], none["psnr_color_views"]) == (None, 0)


def test_log_reports_the_number_of_averaged_views(caplog):
    caplog.set_level("INFO", "clsplat")
    whole = {"psnr": 20.0, "psnr_color": 24.0}
    log_color_metrics({"psnr": 20.0})
    assert not caplog.messages
    for averages, said in (
        (whole, r"PSNR 24.00 dB; the photos' exposures differ"),
        ({**whole, "psnr_color_views": 1, "psnr_color_reason": "why"}, r"PSNR 24.00 dB, the mean of 1 view: why$"),
        (
            {"psnr": 20.0, "psnr_color": None, "psnr_color_reason": "why"},
            r"^color-corrected PSNR cannot be measured: why$",
        ),
    ):
        caplog.clear()
        log_color_metrics(averages)
        (message,) = caplog.messages
        assert re.search(said, message)


def test_best_model_is_chosen_by_psnr_without_color_metrics():
    fitted, bare = {"psnr": 20.0, "psnr_color": 24.0}, {"psnr": 21.0, "psnr_color": None}
    assert comparable_psnr([fitted, fitted]) == [24.0, 24.0]
    assert comparable_psnr([fitted, bare]) == comparable_psnr([fitted, {"psnr": 21.0}]) == [20.0, 21.0]
    assert comparable_psnr([fitted, {}]) == [20.0, None]


def test_steps_are_compared_by_psnr_if_views_lack_colors():
    """30 dB of one view is no better than 31 and 22 dB of two."""
    first = {"psnr": 20.0, **mean_color_metrics([{"psnr_color": 30.0}, {"psnr_affine": 20.0}])}
    second = {"psnr": 21.0, **mean_color_metrics([{"psnr_color": 31.0}, {"psnr_color": 22.0}])}
    assert (first["psnr_color"], second["psnr_color"]) == (30.0, 26.5)
    whole = {"psnr": 22.0, "psnr_color": 29.0}
    assert comparable_psnr([whole, first]) == [22.0, 20.0]
    assert comparable_psnr([first, whole]) == [20.0, 22.0]
    assert comparable_psnr([whole, second]) == [29.0, 26.5]


def test_render_is_regressed_on_the_photograph(rng):
    """With noise in the image its slope is too small by nothing, with noise in the photograph by 1 / (1 + noise)."""
    truth = rng.uniform(0.2, 0.8, (60, 60, 3))
    image = 0.5 * truth + 0.1
    assert correct_by_regression(image, truth, all_pixels(image)) == pytest.approx(truth)
    flat = np.full_like(truth, 0.3)
    assert correct_by_regression(flat, truth, all_pixels(flat)) == pytest.approx(flat)
