"""Rules for distant or large Gaussians (outliers.py), on constructed cases."""

from types import SimpleNamespace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.checks.density import black_photograph
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.density.edit import Edit
from clsplat.density.outliers import PruneFar, PruneWide, largest_on_screen
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import on_devices, on_one_setting


def edit_of(gaussians, survey=None) -> Edit:
    return Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3, survey=survey)


@on_devices("unit", [1.0, 1e-3, 1e3])
def test_far_is_relative_to_the_scene_size(device, rng, unit):
    """Of distances 1 around a middle that is not the origin, with two that are farther."""
    case = random_case(rng, 43)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    around = np.concatenate([directions, -directions, [[0, 0, 0], [0, 99.0, 0], [0, 0, -101.0]]])
    case.parameters["means"][:] = unit * (around + np.array([5.0, 6.0, 7.0]))
    edit = edit_of(case.model(device).gaussians)
    PruneFar().mark(edit)
    assert np.flatnonzero(edit.rows() == 0).tolist() == [42]
    PruneFar(distance_above=98).mark(edit)
    assert np.flatnonzero(edit.rows() == 0).tolist() == [41, 42]


@on_one_setting
def test_empty_model_has_no_center(device, rng):
    edit = edit_of(random_case(rng, 0).model(device).gaussians)
    PruneFar().mark(edit)
    assert edit.rows().tolist() == []


@on_devices("count, width, height", [(0, 16, 16), (17, 33, 31), (40, 24, 24)])
def test_screen_sizes_count_only_views_that_show_the_gaussian(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, MARGIN)
    mask = rng.random((height, width)) < 0.2
    held = [
        black_photograph(device, case, mask),
        black_photograph(device, case, ~mask & (rng.random(mask.shape) < 0.3)),
    ]
    source = SimpleNamespace(get=lambda view: held[view], background=device.zeros(3))
    survey = Survey(Rasterizer(device, "radix"), case.model(device), source, range(2), 0, 0)
    splats, shown = case.project(), np.zeros(count, bool)
    for one in held:
        shown |= ref.contribution(splats, width, height, one.counted()) > 0
    expected = np.where(shown, splats.radius / 3 / width, 0)
    found = largest_on_screen(survey)
    np.testing.assert_allclose(found, expected)
    limit = float(np.median(expected[shown])) if shown.any() else 0.5
    edit = edit_of(case.model(device).gaussians, survey)
    PruneWide(size_above=limit).mark(edit)
    np.testing.assert_array_equal(edit.rows() == 0, found > limit)
    assert count == 0 or 0 < (found > limit).sum() < shown.sum() <= count
