"""Draws by score within a budget (clsplat/methods/taming.py), against the formulas in float64."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import convolve

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.density.budget import BudgetContext
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.methods.adc import Clone, SplitLarge
from clsplat.methods.taming import GrowScored, Parabola, PruneScored, normalize_by_median, view_scores
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import on_devices, on_one_setting

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)


def shares(values: np.ndarray) -> np.ndarray:
    return (values - values.min()) / (values.max() - values.min())


def test_scores_follow_the_formula(device, rng):
    """Two photographs from one camera; the terms one by one from the reference."""
    case = safe_case(rng, 30, 33, 17, MARGIN)
    case.parameters["means"][4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    photographs = rng.integers(0, 256, (2, 3, 17, 33)).astype(np.uint8)
    camera = case.device_camera(device)
    held = {f"{i}": Photograph(camera, device.upload(colors)) for i, colors in enumerate(photographs)}
    views = [SimpleNamespace(name=name, world_to_camera=case.view.world_to_camera) for name in held]
    source = SimpleNamespace(get=lambda view: held[view.name], background=device.upload(BACKGROUND))
    survey = Survey(Rasterizer(device, "radix"), case.model(device), source, views, seed=0, step=0)
    losses, terms = view_scores(survey, 10)

    splats, background = case.project(), BACKGROUND.astype(np.float64)
    image = ref.blend(splats, 33, 17, background)[0]
    weight, visible = ref.blend_weights(splats, 33, 17), splats.radius > 0
    assert not visible[4]
    kernel = np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]])
    expected, total = np.zeros(30), 0.0
    for colors in photographs:
        truth = colors / 255
        edges = np.abs(convolve(truth.mean(axis=0), kernel, mode="nearest"))
        plane = shares(np.abs(image - truth).mean(axis=0)) + shares(edges)
        loss = 0.8 * ref.l1(image, truth)[0] + 0.2 * ref.dssim(image, truth)[0]
        blended = weight > 0
        values = {"depth": splats.depth, "radius": splats.radius, "number": blended.sum(axis=(1, 2))}
        values |= {"pixels": (blended * plane).sum(axis=(1, 2)), "weight": weight.sum(axis=(1, 2))}
        factors = {"depth": 5, "radius": 10, "pixels": 10, "number": 0.1, "weight": 50}
        for name, factor in factors.items():
            value = np.where(visible, values[name], 0)
            expected += loss * factor * value / np.median(value[value > 0])
        total += loss
    np.testing.assert_allclose(losses, total * visible, rtol=1e-5)
    np.testing.assert_allclose(terms, expected, rtol=1e-3)


def test_values_are_divided_by_their_median():
    assert normalize_by_median(np.array([0.0, 1, 2, 4])).tolist() == [0, 0.5, 1, 2]
    assert normalize_by_median(np.zeros(3)).tolist() == [0, 0, 0]
    assert normalize_by_median(np.zeros(0)).tolist() == []


def edit_of(device, rng, sizes, opacity=0.5, losses=1.0, gradient=1.0) -> Edit:
    """An edit whose views see all Gaussians alike; the gradient makes the differences of the score."""
    count = len(sizes)
    case = random_case(rng, count)
    case.parameters["log_scales"][:] = np.log(sizes)[:, None]
    case.parameters["logit_opacity"][:, 0] = np.log(opacity / (1 - np.broadcast_to(opacity, count)))
    gaussians = case.model(device).gaussians
    stats = SplatStats(gaussians)
    gaussians.set("stats/seen", np.ones((count, 1)))
    gaussians.set("stats/screen_grad", np.broadcast_to(gradient, count)[:, None].astype(np.float32))
    survey = SimpleNamespace(compute_once=lambda function, views: (np.broadcast_to(losses, count), np.zeros(count)))
    return Edit(gaussians, stats, SceneScale(1.0), step=600, seed=3, survey=survey)


@on_devices("limit", [None, 400, 200, 150, 131, 101, 100, 99, 40])
def test_growth_respects_budget_and_shares(device, rng, limit):
    """60 to clone and 30 to split in two: the room is divided two to one."""
    edit = edit_of(device, rng, np.repeat([0.005, 0.05, 0.005], [60, 30, 10]), gradient=np.repeat([1.0, 0.0], [90, 10]))
    rules = [Clone(size_below=0.01), SplitLarge(size_above=0.01), GrowScored()]
    change = densify(edit, rules, Rasterizer(device, "radix").tiler, limit)
    room = 90 if limit is None else min(90, max(0, limit - 100))
    assert change.after == 100 + room
    assert abs(change.causes["split"] - room / 3) <= 0.5
    assert change.causes["clone"] + change.causes["split"] == room


@on_devices("limit", [200, 99, 40])
def test_no_growth_draws_nothing(device, rng, limit):
    edit = edit_of(device, rng, np.full(100, 0.005), gradient=0.0)
    rules = [Clone(size_below=0.01), GrowScored()]
    assert densify(edit, rules, Rasterizer(device, "radix").tiler, limit).after == 100


@on_one_setting
def test_growth_is_drawn_by_score(device, rng):
    """Score of one in ten is (25 * 39 + 125) / (25 + 125) times that of the others; half of the weight grows most."""
    gradient = np.where(np.arange(200) < 20, 39.0, 1.0)
    counts = np.zeros(200)
    for seed in range(60):
        edit = edit_of(device, rng, np.full(200, 0.005), gradient=gradient)
        edit.seed, edit.max_rows = seed, 210
        Clone(size_below=0.01).mark(edit)
        GrowScored().mark(edit)
        assert (edit.row_counts() > 1).sum() == 10
        counts += edit.row_counts() > 1
    share = 22 / 3 * 20 / (22 / 3 * 20 + 180)  # of the first draw; a little less of ten
    assert counts[:20].sum() / counts.sum() == pytest.approx(share, abs=0.06)


@on_one_setting
def test_low_scores_are_pruned_first(device, rng):
    """Of two faint ones with scores 1 and 4, one goes: the first four times of five."""
    counts = np.zeros(2)
    for seed in range(300):
        edit = edit_of(device, rng, np.full(2, 0.005), opacity=0.001, losses=np.array([1.0, 4.0]))
        edit.seed = seed
        PruneScored(share=0.5).mark(edit)
        counts += edit.row_counts() == 0
    assert counts.sum() == 300
    assert counts[0] / 300 == pytest.approx(0.8, abs=0.07)


def limit(most: int, count: int, edits: int) -> int:
    """What the budget allows to an edit of `count` Gaussians, the first of so many."""
    edit = SimpleNamespace(gaussians=SimpleNamespace(count=count))
    return Parabola(gaussians=most).limit(edit, BudgetContext(progress=0.5, remaining_edits=edits, divisor=1.0), {})


@pytest.mark.parametrize(("first", "most", "edits"), [(100, 1500, 28), (1000, 1001, 5), (10, 10**6, 1), (7, 8, 100)])
def test_budget_is_the_papers_parabola(first, most, edits):
    count = first
    for x in range(1, edits + 1):
        count = limit(most, count, edits - x + 1)
        share = x / edits
        assert count == pytest.approx(first + (most - first) * (2 * share - share**2), abs=x)
        assert count <= most
    assert count == most


def test_budget_compensates_pruning_and_refuses_more():
    assert limit(100, 40, 2) == 85
    assert limit(100, 0, 1) == 100
    assert limit(100, 100, 3) == limit(100, 170, 3) == 100
