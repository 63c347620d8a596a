"""Rules that subdivide, thin and merge, on constructed cases."""

import numpy as np
import pytest

from clsplat.gaussians.model import INTERVAL2
from clsplat.render.renderer import Renderer
from clsplat.training.adam import Adam
from clsplat.training.basic_rules import Clone, PruneFaint
from clsplat.training.density import Measures, densify
from clsplat.training.detail_rules import SplitOversized, SplitTextured, largest
from clsplat.training.statistics import SEEN, SplatStats
from clsplat.training.thinning_rules import MergeNeighbours, PruneUnimportant, covariance_of, mass_of, merged
from clsplat.training.thresholds import PixelQuantile, Quantile
from tests.scenes import random_case

COLUMNS = ["screen_grad", "texture", "screen_radius"]
EXTENT = 2.0


class Edited:
    """Gaussians with chosen statistics, before and after an edit."""

    def __init__(self, device, rng, count: int, **columns) -> None:
        case = random_case(rng, count)
        self.gaussians = case.model(device).gaussians
        self.tiler = Renderer(device, "radix").tiler
        Adam(self.gaussians)
        for table in [name for name in self.gaussians.tables if "moment" in name]:
            self.gaussians.set(table, rng.uniform(1, 2, (count, self.gaussians.tables[table].components)))
        self.stats = SplatStats(self.gaussians, COLUMNS)
        self.gaussians.set(SEEN, np.full((count, 1), 2.0, np.float32))
        for name in COLUMNS:
            values = np.broadcast_to(columns.get(name, 10.0), count).astype(np.float32)
            self.gaussians.set(f"stats/{name}", 2 * values[:, None])

    def apply(self, *rules, most=None, texture_quantile=lambda share: 0.1 * share):
        self.before = {name: self.gaussians.get(name) for name in self.gaussians.tables}
        measures = Measures(EXTENT, texture_quantile)
        return densify(self.gaussians, self.stats, rules, self.tiler, measures, 700, seed=4, most=most)

    def rows_of(self, source: int) -> np.ndarray:
        """Rows that carry the colours of an old row, which no edit changes."""
        return np.flatnonzero((self.gaussians.get("sh_rest") == self.before["sh_rest"][source]).all(axis=1))


def test_texture_splits_and_children_are_half_as_large(device, rng):
    texture = np.tile([0.01, 0.3], 20)
    case = Edited(device, rng, 40, texture=texture, screen_grad=1.0)
    change = case.apply(SplitTextured(texture_above=0.1, gradient_above=0.0, at_most=1.0))
    assert (change.before, change.after, change.causes) == (40, 60, {"split_textured": 20})
    for source in range(40):
        rows = case.rows_of(source)
        if texture[source] < 0.1:
            assert len(rows) == 1
            np.testing.assert_array_equal(case.gaussians.get("means")[rows[0]], case.before["means"][source])
            continue
        assert len(rows) == 2
        parent, children = case.before["log_scales"][source], case.gaussians.get("log_scales")[rows]
        np.testing.assert_allclose(np.exp(2 * (children - parent)), 0.5, rtol=1e-4)  # β
        assert (case.gaussians.get("means")[rows] != case.before["means"][source]).any(axis=1).all()
        for table in case.gaussians.tables:
            if "moment" in table or table.startswith("stats/"):
                assert (case.gaussians.get(table)[rows] == 0).all(), table


def test_strict_and_lowered(device, rng):
    """Lowered also wants some screen gradient; both leave smooth places and tiny splats alone."""
    columns = {
        "texture": [0.3, 0.3, 0.3, 0.01],
        "screen_grad": [2e-4, 1e-5, 2e-4, 2e-4],
        "screen_radius": [5, 5, 1, 5],
    }
    for gradient_above, expected in ((0.0, [2, 2, 1, 1]), (1e-4, [2, 1, 1, 1])):
        case = Edited(device, rng, 4, **columns)
        case.apply(SplitTextured(texture_above=0.1, gradient_above=gradient_above, at_most=1.0))
        assert [len(case.rows_of(n)) for n in range(4)] == expected


def test_only_the_most_textured_share_splits(device, rng):
    texture = rng.permutation(np.linspace(0.2, 0.9, 100))
    case = Edited(device, rng, 100, texture=texture)
    change = case.apply(SplitTextured(texture_above=0.0, gradient_above=0.0, at_most=0.07))
    assert change.after == 107
    assert {n for n in range(100) if len(case.rows_of(n)) == 2} == set(np.argsort(-texture)[:7])


def test_ties_go_to_the_first():
    chosen = largest(np.array([True, False, True, True]), np.array([1, 9, 1, 1], np.float32), 2)
    assert chosen.tolist() == [True, False, True, False]


def test_quantiles_are_of_pixels_or_of_gaussians(device, rng):
    texture = np.linspace(0.01, 0.1, 50)
    of_pixels = PixelQuantile(quantile=0.5, of="pixels")
    for above, expected in ((of_pixels, (texture >= 0.05).sum()), (Quantile(quantile=0.5), 25)):
        case = Edited(device, rng, 50, texture=texture)
        rule = SplitTextured(texture_above=above, gradient_above=0.0, at_most=1.0)
        assert case.apply(rule).after == 50 + expected


@pytest.mark.parametrize(("rms_above", "pixels"), [(0.01, None), (0.01, 4.0), (Quantile(quantile=0.8), None)])
def test_oversized_ones_split(device, rng, rms_above, pixels):
    case = Edited(device, rng, 60)
    log_scales = rng.normal(np.log(0.02), 0.5, (60, 3)).astype(np.float32)
    interval = rng.uniform(0.002, 0.02, 60).astype(np.float32)
    case.gaussians.set("log_scales", log_scales)
    case.gaussians.add(INTERVAL2, 1)
    case.gaussians.set(INTERVAL2, interval[:, None] ** 2)
    case.apply(SplitOversized(rms_above=rms_above, pixels=pixels, at_most=1.0))
    trace = np.exp(2.0 * log_scales).sum(axis=1)
    bound = pixels * interval if pixels else 0.01 * EXTENT
    if isinstance(rms_above, Quantile):
        bound = np.sqrt(np.sort(trace)[-13] / 3)  # a fifth of them are larger
    penalised = trace > 1.0001 * 3 * bound**2  # P > 0
    assert 5 < penalised.sum() < 55
    assert [len(case.rows_of(n)) for n in range(60)] == np.where(penalised, 2, 1).tolist()


def test_first_growing_rule_takes_it_and_pruning_overrides(device, rng):
    case = Edited(device, rng, 30, texture=1.0, screen_grad=1.0)
    logits = np.where(np.arange(30) % 3 == 0, -7.0, 2.0).astype(np.float32)
    case.gaussians.set("logit_opacity", logits[:, None])
    rules = [Clone(size_below=1e9), SplitTextured(texture_above=0.1, at_most=1.0), PruneFaint()]
    change = case.apply(*rules)
    assert change.causes == {"clone": 20, "split_textured": 0, "prune_faint": 10}
    assert [len(case.rows_of(n)) for n in range(30)] == np.where(logits < 0, 0, 2).tolist()


def test_growth_stops_at_the_limit_and_the_largest_gradients_grow(device, rng):
    gradient = rng.permutation(np.linspace(1e-3, 1, 50))
    case = Edited(device, rng, 50, screen_grad=gradient)
    change = case.apply(Clone(size_below=1e9), most=58)
    assert (change.after, change.causes) == (58, {"clone": 8})
    assert {n for n in range(50) if len(case.rows_of(n)) == 2} == set(np.argsort(-gradient)[:8])
    assert case.apply(Clone(size_below=1e9), most=10).after == 58  # nothing is removed to reach it


def test_least_important_ones_go(device, rng):
    case = Edited(device, rng, 40)
    change = case.apply(PruneUnimportant(share=0.25))
    opacity = 1 / (1 + np.exp(-case.before["logit_opacity"][:, 0].astype(np.float64)))
    score = opacity * np.exp(case.before["log_scales"].astype(np.float64).mean(axis=1))
    assert change.after == 30
    assert {n for n in range(40) if len(case.rows_of(n)) == 0} == set(np.argsort(score)[:10])


def test_neighbours_merge_into_their_moments(device, rng):
    """Twins merge; a stranger of another colour and one far away stay."""
    case = Edited(device, rng, 4)
    means = np.array([[0, 0, 4], [0.01, 0, 4], [5, 0, 4], [5.01, 0, 4]], np.float32)
    colours = np.array([[0.2] * 3, [0.21] * 3, [0.2] * 3, [2.0] * 3], np.float32)
    case.gaussians.set("means", means)
    case.gaussians.set("sh_base", colours)
    case.gaussians.set("log_scales", np.log(np.full((4, 3), [0.05, 0.04, 0.03], np.float32)))
    case.gaussians.set("logit_opacity", np.array([[-1.0], [-1.5], [1.0], [0.0]], np.float32))
    before = {name: case.gaussians.get(name).astype(np.float64) for name in ("quats", "log_scales", "logit_opacity")}
    moment = case.gaussians.get("adam/means/moment1")
    assert case.apply(MergeNeighbours()).after == 3
    tables = {**before, "means": means.astype(np.float64)}
    mass = mass_of(tables)[:2]
    weights = mass / mass.sum()
    mean = weights @ tables["means"][:2]
    own = covariance_of(before["quats"][:2], before["log_scales"][:2])
    offset = tables["means"][:2] - mean
    covariance = np.einsum("n,nij->ij", weights, own + offset[:, :, None] * offset[:, None, :])
    got = {name: case.gaussians.get(name).astype(np.float64) for name in (*before, "means", "sh_base")}
    np.testing.assert_allclose(got["means"][0], mean, atol=1e-6)
    np.testing.assert_allclose(covariance_of(got["quats"][:1], got["log_scales"][:1])[0], covariance, atol=1e-7)
    np.testing.assert_allclose(mass_of(got)[0], mass.sum(), rtol=1e-4)
    np.testing.assert_allclose(got["sh_base"][0], weights @ colours[:2], rtol=1e-5)
    np.testing.assert_array_equal(case.gaussians.get("adam/means/moment1")[0], moment[0])  # the heavier one's
    np.testing.assert_array_equal(got["means"][1:], means[2:])


def test_a_merged_covariance_is_a_covariance(rng):
    count = 50
    tables = {
        "means": rng.normal(0, 1, (2 * count, 3)),
        "quats": rng.normal(size=(2 * count, 4)),
        "log_scales": rng.normal(-2, 1, (2 * count, 3)),
        "logit_opacity": rng.normal(0, 2, (2 * count, 1)),
        "sh_base": rng.normal(size=(2 * count, 3)),
        "sh_rest": rng.normal(size=(2 * count, 45)),
    }
    found = merged(tables, np.arange(count), np.arange(count, 2 * count))
    np.testing.assert_allclose(np.linalg.norm(found["quats"], axis=1), 1, rtol=1e-9)
    assert all(np.isfinite(values).all() for values in found.values())
    again = covariance_of(found["quats"], found["log_scales"])
    np.testing.assert_allclose(again, np.swapaxes(again, 1, 2), atol=1e-12)
