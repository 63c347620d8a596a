"""Splits along the longest axis by an edge-aware score (clsplat/methods/improved_gs.py), against float64."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import sobel

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.core.quaternions import rotation_matrix
from clsplat.density.budget import BudgetContext
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.methods.improved_gs import PruneLowestOpacity, SplitLongAxis, SquareRoot, edge_scores
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import on_one_setting


def edit_of(device, rng, count: int, scores: np.ndarray, seed: int = 3) -> Edit:
    """An edit of Gaussians, the first half of which have large gradients, with given scores."""
    gaussians = random_case(rng, count).model(device).gaussians
    stats = SplatStats(gaussians, {"screen_grad_abs"})
    gaussians.set(SEEN, np.ones((count, 1)))
    gaussians.set("stats/screen_grad_abs", np.where(np.arange(count) < count // 2, 1.0, 0.0)[:, None])
    survey = SimpleNamespace(compute_once=lambda function, views: scores)
    return Edit(gaussians, stats, SceneScale(1.0), step=600, seed=seed, survey=survey)


@on_one_setting
def test_children_follow_the_formula(device, rng):
    edit = edit_of(device, rng, 20, np.ones(20))
    before = {name: edit.gaussians.get(name).astype(np.float64) for name in edit.gaussians.tables}
    split = SplitLongAxis(distance=0.4, opacity=0.6, long_axis=0.5, other_axes=0.8)
    assert densify(edit, [split], Rasterizer(device, "radix").tiler).after == 30
    for parent in range(10):
        rows = np.flatnonzero((edit.gaussians.get("sh_rest") == before["sh_rest"][parent]).all(axis=1))
        means, log_scales, logits = (
            edit.gaussians.get(name)[rows] for name in ("means", "log_scales", "logit_opacity")
        )
        scales = np.exp(before["log_scales"][parent])
        longest = scales.argmax()
        quat = before["quats"][parent]
        axis = rotation_matrix(*(quat / np.linalg.norm(quat)))[:, longest]
        offset = 0.4 * scales[longest] * axis
        np.testing.assert_allclose(means, before["means"][parent] + [offset, -offset], rtol=1e-5, atol=1e-6)
        factors = np.where(np.arange(3) == longest, 0.5, 0.8)
        np.testing.assert_allclose(np.exp(log_scales), np.broadcast_to(factors * scales, (2, 3)), rtol=1e-5)
        opacity = 0.6 / (1 + np.exp(-before["logit_opacity"][parent]))
        np.testing.assert_allclose(1 / (1 + np.exp(-logits)), np.broadcast_to(opacity, (2, 1)), rtol=1e-5)
    np.testing.assert_array_equal(edit.gaussians.get("means")[-10:], before["means"][10:].astype(np.float32))


@on_one_setting
@pytest.mark.parametrize("room", [-3, 0, 4])
def test_splits_beyond_the_limit_are_sampled_by_score(device, rng, room):
    """Only six of the ten with large gradients have a score; four of them are split."""
    edit = edit_of(device, rng, 20, np.where(np.arange(20) % 10 < 6, 1.0, 0.0))
    edit.max_rows = 20 + room
    SplitLongAxis().mark(edit)
    rows = edit.row_counts()
    assert (rows == 2).sum() == max(room, 0)
    assert (rows[6:] == 1).all()


def test_scores_are_blend_weights_times_edges(device, rng):
    case = safe_case(rng, 30, 33, 17, MARGIN)
    photographs = rng.integers(0, 256, (2, 3, 17, 33)).astype(np.uint8)
    camera = case.device_camera(device)
    by_name = {f"{i}": Photograph(camera, device.upload(colors)) for i, colors in enumerate(photographs)}
    views = [SimpleNamespace(name=name, world_to_camera=case.view.world_to_camera) for name in by_name]
    source = SimpleNamespace(get=lambda view: by_name[view.name], background=device.upload(np.zeros(3, np.float32)))
    scores = edge_scores(Survey(Rasterizer(device, "radix"), case.model(device), source, views, seed=0, step=0), 10)
    weight, expected = ref.blend_weights(case.project(), 33, 17), np.zeros(30)
    for colors in photographs:
        gray = colors.mean(axis=0)
        edges = np.hypot(sobel(gray, 0, mode="nearest"), sobel(gray, 1, mode="nearest"))
        expected += (weight * (edges - edges.min()) / (edges.max() - edges.min())).sum(axis=(1, 2))
    assert (expected > 0).sum() > 10
    np.testing.assert_allclose(scores, expected, rtol=1e-3, atol=1e-5 * expected.max())


def test_lowest_opacities_are_pruned_and_growth_is_a_root(device, rng):
    edit = edit_of(device, rng, 20, np.ones(20))
    logits = edit.gaussians.get("logit_opacity")[:, 0]
    PruneLowestOpacity(share=0.2).mark(edit)
    assert set(np.flatnonzero(edit.row_counts() == 0)) == set(np.argsort(logits)[:4])
    limits = [SquareRoot(gaussians=1000).limit(edit, BudgetContext(x, 1, 1.0), {}) for x in (0.04, 0.25, 1.0)]
    assert limits == [200, 500, 1000]
