"""Importance by blend weights in several views (mini_splatting.py), against the reference."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.checks.density import black_photograph
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.density.edit import Edit
from clsplat.density.importance import Weights, select_by_weight
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.methods.mini_splatting import PruneUseless, find_useless, sampled_weights
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import on_devices, on_one_setting


@on_devices("count, width, height", [(0, 16, 16), (1, 16, 16), (17, 33, 31), (40, 24, 24)])
def test_weights_match_the_reference(device, rng, count, width, height):
    """Two views that differ by their masks; the useful ones by adding weights one after another."""
    case = safe_case(rng, count, width, height, MARGIN)
    masks = [rng.random((height, width)) < share for share in (0.9, 0.2)]
    held = [black_photograph(device, case, mask) for mask in masks]
    source = SimpleNamespace(get=lambda view: held[view], background=device.zeros(3))
    found = sampled_weights(Survey(Rasterizer(device, "radix"), case.model(device), source, range(2), 0, 0), 0.9)
    expected = [ref.contribution(case.project(), width, height, mask) for mask in masks]
    np.testing.assert_allclose(found.total, sum(expected), rtol=1e-4, atol=1e-5)
    views = np.zeros(count, int)
    for weight in expected:
        made = 0.0
        for i in sorted(range(count), key=lambda i: -weight[i]):
            if made >= 0.9 * weight.sum() or weight[i] == 0:
                break
            made += weight[i]
            views[i] += 1
    np.testing.assert_array_equal(found.views, views)


@on_one_setting
def test_views_are_sampled(device, rng):
    case = safe_case(rng, 17, 33, 31, MARGIN)
    held = [black_photograph(device, case, rng.random((31, 33)) < 0.8) for _ in range(5)]
    source = SimpleNamespace(get=lambda view: held[view], background=device.zeros(3))
    survey = Survey(Rasterizer(device, "radix"), case.model(device), source, range(5), 3, 600)
    places = survey.sample_views(2)
    of_two = sampled_weights(survey, 0.9, 2)
    alone = Survey(Rasterizer(device, "radix"), case.model(device), source, places, 3, 600)
    expected = sampled_weights(alone, 0.9)
    np.testing.assert_array_equal(of_two.total, expected.total)
    np.testing.assert_array_equal(of_two.views, expected.views)
    np.testing.assert_array_equal(sampled_weights(survey, 0.9, 9).total, sampled_weights(survey, 0.9).total)


@on_devices("count, width, height", [(0, 16, 16), (1, 16, 16), (17, 33, 31), (40, 24, 24)])
def test_each_view_needs_its_heaviest_gaussians(device, rng, count, width, height):
    case = safe_case(rng, count, width, height, MARGIN)
    case.parameters["means"][::7] += 100.0  # out of sight
    masks = [rng.random((height, width)) < share for share in (0.9, 0.2)]
    held = [black_photograph(device, case, mask) for mask in masks]
    source = SimpleNamespace(get=lambda view: held[view], background=device.zeros(3))
    survey = Survey(Rasterizer(device, "radix"), case.model(device), source, range(2), 0, 0)
    for share in (0.0, 0.9, 1.0):
        found = find_useless(survey, share)
        for here, mask in zip(found, masks, strict=True):
            splats = case.project()
            weight = ref.contribution(splats, width, height, mask)
            expected = (splats.radius > 0) & ~select_by_weight(weight, share)
            np.testing.assert_array_equal(here, expected)


@pytest.mark.parametrize(
    ("weight", "share", "expected"),
    [
        ([1, 2, 3, 4], 0.7, [0, 0, 1, 1]),
        ([1, 2, 3, 4], 0.71, [0, 1, 1, 1]),
        ([1, 2, 3, 4], 1.0, [1, 1, 1, 1]),
        ([0, 2, 0, 4], 1.0, [0, 1, 0, 1]),
        ([1, 1, 1, 1], 0.5, [1, 1, 0, 0]),
        ([0, 0], 0.99, [0, 0]),
        ([], 0.99, []),
    ],
)
def test_heaviest_gaussians_reach_the_fraction(weight, share, expected):
    assert select_by_weight(np.array(weight, float), share).tolist() == expected


@on_one_setting
def test_rarely_needed_and_light_gaussians_are_pruned(device, rng):
    gaussians = random_case(rng, 5).model(device).gaussians
    found = Weights(np.array([500.0, 300, 200, 0.5, 0.4]), np.array([3, 1, 2, 3, 4]))
    survey = SimpleNamespace(compute_once=lambda function, *arguments: found)
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3, survey=survey)
    edit.mark(copies=2, old_rows=1)
    PruneUseless(views_below=2, weight_total=0.999).mark(edit)
    assert edit.row_counts().tolist() == [2, 0, 2, 0, 0]
