"""Advice in the report, from metrics of views and camera positions."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.metrics.views import ViewMetrics
from clsplat.pipeline.loading import load
from clsplat.render.backdrops import Auto, Backdrop, EnvironmentMap
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.stages.advice import (
    FEW_PHOTOS,
    LOW_PSNR,
    advise_on_capture,
    advise_on_fit,
    advise_on_test_views,
    advise_on_training_views,
    find_outliers,
    find_widest_gap,
)
from clsplat.training.modules.sky_choice import sky_reason

AGAIN = "clsplat run out/pipeline.yaml"
CAMERA = Camera(40, 30, 40.0, 40.0, 20.0, 15.0)


def views_around(degrees: list[float], outward: bool = False) -> list[View]:
    """Views on a circle around the origin that look at it, or away from it, named after their angles."""
    found = []
    for angle in degrees:
        eye = 3 * np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.2])
        target = 2 * eye if outward else np.zeros(3)
        found.append(View.looking_at(eye, target, np.array([0.0, 0.0, 1.0]), CAMERA, f"at {angle:g}"))
    return found


def measured(psnr: list[float], gained: float = 0.0) -> list[ViewMetrics]:
    return [ViewMetrics(f"{i}.jpg", one, 0.9, {}, {"psnr_color": one + gained}) for i, one in enumerate(psnr)]


def test_views_far_below_the_median_are_named_worst_first():
    assert find_outliers({}) == []
    assert find_outliers({"a": 30.0, "b": 25.0, "c": 31.0}) == []
    assert find_outliers({"a": 30.0, "b": 24.9, "c": 31.0, "d": 12.0, "e": 30.0}) == ["d", "b"]


def test_training_photographs_that_disagree_are_named():
    (text,) = advise_on_training_views(measured([30, 31, 10, 30]), False, AGAIN, 900)
    assert text.startswith("2.jpg disagrees with the other photos")
    assert text.endswith(f"`{AGAIN} --set 'optimize.modules.transients={{start: 300}}'`")
    load("photos", ["optimize.modules.transients={start: 300}"])
    (text,) = advise_on_training_views(measured([30, 31, 10, 30]), False, AGAIN, None)
    assert text.endswith(f"then `{AGAIN}`")
    (text,) = advise_on_training_views(measured([30] * 9 + [10, 11, 12, 13, 14]), False, AGAIN, 900)
    assert text.startswith("9.jpg, 10.jpg, 11.jpg and 2 more disagree with")
    assert not [*advise_on_training_views([], False, AGAIN, 900)]


@pytest.mark.parametrize(("gained", "has_exposures", "said"), [(0.9, False, 0), (1.5, False, 1), (1.5, True, 0)])
def test_differing_colors_are_reported_if_none_are_trained(gained, has_exposures, said):
    texts = [*advise_on_training_views(measured([30, 30, 31], gained), has_exposures, AGAIN, 900)]
    assert len(texts) == said
    assert all("would gain 1.5 dB" in text and "optimize.modules.exposure={}" in text for text in texts)


def test_images_without_fitted_colors_are_ignored():
    found = [*measured([30, 30], 1.5), ViewMetrics("half.jpg", 30, 0.9, {}, {"psnr_affine": 90.0})]
    assert "would gain 1.5 dB" in "".join(advise_on_training_views(found, False, AGAIN, 900))
    assert not [*advise_on_training_views(found[2:], False, AGAIN, 900)]


def test_much_worse_test_views_are_named():
    (text,) = advise_on_test_views({"a": 22.0, "b": 16.0, "c": 26.0}, AGAIN)
    assert text.startswith("b: much worse")


def run_with(background: Backdrop | None) -> SimpleNamespace:
    return SimpleNamespace(model_settings=SimpleNamespace(background=background))


def test_added_sky_is_reported_with_its_reason():
    added = Auto(chosen="on", reason="25 of 25 photos show one; 25% of them")
    assert sky_reason(run_with(added)) == "25 of 25 photos show one"
    assert not any(sky_reason(run_with(other)) for other in (None, EnvironmentMap(), Auto(), Auto(chosen="off")))


@pytest.mark.parametrize(
    ("psnr", "is_overfit", "start"),
    [
        (LOW_PSNR - 1, True, "the model overfits"),
        (LOW_PSNR - 1, False, "the model underfits: only 23.0 dB"),
        (LOW_PSNR, False, ""),
    ],
)
def test_what_limited_the_fit_is_named_once(psnr, is_overfit, start):
    texts = [*advise_on_fit(measured([psnr - 1, psnr + 1]), is_overfit, "again", "longer")]
    assert len(texts) == bool(start)
    command = "again" if is_overfit else "longer"
    assert all(text.startswith(start) and text.endswith(f"`{command}`") for text in texts)


def test_few_images_are_reported():
    assert "only 1 training photo" in "".join(advise_on_capture(views_around([0]), views_around([0]), AGAIN))
    many = views_around([i * 360 / FEW_PHOTOS for i in range(FEW_PHOTOS)])
    assert not [*advise_on_capture(many, many, AGAIN)]


@pytest.mark.parametrize("turn", [0, 250])
def test_widest_gap_around_a_scene_is_reported(turn):
    angles = [turn + 12 * i for i in range(26)]  # 300 degrees, and 60 without any
    degrees, one, other = find_widest_gap(views_around(angles))
    assert degrees == pytest.approx(60, abs=1)
    assert (one, other) == (f"at {angles[-1]:g}", f"at {angles[0]:g}")


@pytest.mark.parametrize(
    "views",
    [
        views_around([0, 10]),
        views_around([12 * i for i in range(30)]),  # all around
        views_around([10 * i for i in range(13)]),  # from one side
        views_around([0, 90, 180, 270]),  # evenly
        views_around([12 * i for i in range(26)], outward=True),
    ],
    ids=["two", "all around", "one side", "evenly", "outward"],
)
def test_even_coverage_has_no_gap(views):
    assert find_widest_gap(views) is None


def test_coincident_cameras_have_no_gap():
    assert find_widest_gap([views_around([0])[0]] * 5) is None
