"""Rules that split, prune, and merge, on constructed cases."""

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.conformance.scenes import random_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.importance import select_largest
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.thresholds import PixelQuantile, Quantile, SceneScale
from clsplat.gaussians.gaussians import INTERVAL2
from clsplat.gaussians.mixture import covariance_matrices, masses, merge
from clsplat.methods.adc import Clone, PruneFaint
from clsplat.methods.micro_splatting import MergeNeighbors, PruneUnimportant, SplitOversized, SplitTextured
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam
from tests.support.devices import on_devices, on_one_setting

COLUMNS = ["screen_grad", "texture", "screen_radius"]
EXTENT = 2.0


class Edited:
    """Gaussians with chosen statistics, before and after an edit."""

    def __init__(self, device, rng, count: int, names=COLUMNS, **columns) -> None:
        case = random_case(rng, count)
        self.gaussians = case.model(device).gaussians
        self.tiler = Rasterizer(device, "radix").tiler
        Adam(self.gaussians)
        for table in [name for name in self.gaussians.tables if "moment" in name]:
            self.gaussians.set(table, rng.uniform(1, 2, (count, self.gaussians.tables[table].components)))
        self.stats = SplatStats(self.gaussians, names)
        self.gaussians.set(SEEN, np.full((count, 1), 2.0, np.float32))
        for name in self.stats.names:
            values = np.broadcast_to(columns.get(name, 1.0 if name == "blend_weight" else 10.0), count)
            self.gaussians.set(f"stats/{name}", 2 * values.astype(np.float32)[:, None])

    def apply(self, *rules, limit=None, texture_quantile=lambda share: 0.1 * share):
        self.before = {name: self.gaussians.get(name) for name in self.gaussians.tables}
        edit = Edit(self.gaussians, self.stats, SceneScale(EXTENT, texture_quantile), step=700, seed=4)
        return densify(edit, rules, self.tiler, limit)

    def rows_of(self, source: int) -> np.ndarray:
        """Rows that carry the colors of an old row, which no edit changes."""
        return np.flatnonzero((self.gaussians.get("sh_rest") == self.before["sh_rest"][source]).all(axis=1))


@on_one_setting
def test_texture_splits_and_children_are_half_as_large(device, rng):
    texture = np.tile([0.01, 0.3], 20)
    case = Edited(device, rng, 40, texture=texture, screen_grad=1.0)
    change = case.apply(SplitTextured(texture_above=0.1, gradient_above=0.0, max_fraction=1.0))
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


@on_one_setting
def test_strict_and_relaxed_forms(device, rng):
    """The lowered form also needs some screen gradient; both forms ignore smooth places and tiny splats."""
    columns = {
        "texture": [0.3, 0.3, 0.3, 0.01],
        "screen_grad": [2e-4, 1e-5, 2e-4, 2e-4],
        "screen_radius": [5, 5, 1, 5],
    }
    for gradient_above, expected in ((0.0, [2, 2, 1, 1]), (1e-4, [2, 1, 1, 1])):
        case = Edited(device, rng, 4, **columns)
        case.apply(SplitTextured(texture_above=0.1, gradient_above=gradient_above, max_fraction=1.0))
        assert [len(case.rows_of(n)) for n in range(4)] == expected


@on_one_setting
def test_only_the_most_textured_fraction_splits(device, rng):
    texture = rng.permutation(np.linspace(0.2, 0.9, 100))
    case = Edited(device, rng, 100, texture=texture)
    change = case.apply(SplitTextured(texture_above=0.0, gradient_above=0.0, max_fraction=0.07))
    assert change.after == 107
    assert {n for n in range(100) if len(case.rows_of(n)) == 2} == set(np.argsort(-texture)[:7])


def test_ties_go_to_the_first():
    chosen = select_largest(np.array([1, 9, 1, 1], np.float32), 2, np.array([True, False, True, True]))
    assert chosen.tolist() == [True, False, True, False]


@on_one_setting
def test_quantiles_are_of_pixels_or_of_gaussians(device, rng):
    texture = np.linspace(0.01, 0.1, 50)
    of_pixels = PixelQuantile(quantile=0.5, of="pixels")
    for above, expected in ((of_pixels, (texture >= 0.05).sum()), (Quantile(quantile=0.5), 25)):
        case = Edited(device, rng, 50, texture=texture)
        rule = SplitTextured(texture_above=above, gradient_above=0.0, max_fraction=1.0)
        assert case.apply(rule).after == 50 + expected


@on_one_setting
def test_quantiles_are_over_visible_gaussians(device, rng):
    texture = np.where(np.arange(50) < 10, np.linspace(0.01, 0.1, 50), 0.0)
    case = Edited(device, rng, 50, texture=texture)
    case.gaussians.set(SEEN, 2.0 * (texture > 0)[:, None])
    rule = SplitTextured(texture_above=Quantile(quantile=0.8), gradient_above=0.0, max_fraction=1.0)
    assert case.apply(rule).after == 52
    unseen = Edited(device, rng, 50)
    unseen.gaussians.set(SEEN, np.zeros((50, 1)))
    assert unseen.apply(rule).after == 50


@on_devices("rms_above, pixels", [(0.01, None), (0.01, 4.0), (Quantile(quantile=0.8), None)])
def test_oversized_gaussians_split(device, rng, rms_above, pixels):
    case = Edited(device, rng, 60)
    log_scales = rng.normal(np.log(0.02), 0.5, (60, 3)).astype(np.float32)
    interval = rng.uniform(0.002, 0.02, 60).astype(np.float32)
    case.gaussians.set("log_scales", log_scales)
    case.gaussians.add(INTERVAL2, 1)
    case.gaussians.set(INTERVAL2, interval[:, None] ** 2)
    case.apply(SplitOversized(rms_above=rms_above, pixels=pixels, max_fraction=1.0))
    trace = np.exp(2.0 * log_scales).sum(axis=1)
    bound = pixels * interval if pixels else 0.01 * EXTENT
    if isinstance(rms_above, Quantile):
        bound = np.sqrt(np.sort(trace)[-13] / 3)  # a fifth of them are larger
    penalized = trace > 1.0001 * 3 * bound**2  # P > 0
    assert 5 < penalized.sum() < 55
    assert [len(case.rows_of(n)) for n in range(60)] == np.where(penalized, 2, 1).tolist()


@on_one_setting
def test_first_growing_rule_takes_it_and_pruning_overrides(device, rng):
    case = Edited(device, rng, 30, texture=1.0, screen_grad=1.0)
    logits = np.where(np.arange(30) % 3 == 0, -7.0, 2.0).astype(np.float32)
    case.gaussians.set("logit_opacity", logits[:, None])
    rules = [Clone(size_below=1e9), SplitTextured(texture_above=0.1, max_fraction=1.0), PruneFaint()]
    change = case.apply(*rules)
    assert change.causes == {"clone": 20, "split_textured": 0, "prune_faint": 10}
    assert [len(case.rows_of(n)) for n in range(30)] == np.where(logits < 0, 0, 2).tolist()


@on_one_setting
def test_growth_stops_at_the_limit_with_the_largest_gradients(device, rng):
    gradient = rng.permutation(np.linspace(1e-3, 1, 50))
    case = Edited(device, rng, 50, screen_grad=gradient)
    change = case.apply(Clone(size_below=1e9), limit=58)
    assert (change.after, change.causes) == (58, {"clone": 8})
    assert {n for n in range(50) if len(case.rows_of(n)) == 2} == set(np.argsort(-gradient)[:8])
    crowded = Edited(device, rng, 50, screen_grad=gradient)
    assert crowded.apply(Clone(size_below=1e9), limit=10).after == 50  # nothing is removed to reach it


@on_one_setting
def test_limit_ranks_by_gradient_with_any_statistic(device, rng):
    gradient = rng.permutation(np.linspace(1e-3, 1, 50))
    case = Edited(device, rng, 50, ("rendered_texture", "screen_grad", "screen_radius"))
    case.gaussians.set("stats/screen_grad", 2 * gradient[:, None])
    case.gaussians.set("stats/rendered_texture", 2 * (1 - gradient[:, None]))
    case.apply(
        SplitTextured(texture="rendered_texture", texture_above=0.0, gradient_above=0.0, max_fraction=1.0), limit=58
    )
    assert {n for n in range(50) if len(case.rows_of(n)) == 2} == set(np.argsort(-gradient)[:8])


@on_one_setting
def test_least_important_gaussians_are_pruned(device, rng):
    case = Edited(device, rng, 40)
    change = case.apply(PruneUnimportant(share=0.25))
    opacity = 1 / (1 + np.exp(-case.before["logit_opacity"][:, 0].astype(np.float64)))
    score = opacity * np.exp(case.before["log_scales"].astype(np.float64).mean(axis=1))
    assert change.after == 30
    assert {n for n in range(40) if len(case.rows_of(n)) == 0} == set(np.argsort(score)[:10])


@on_one_setting
def test_merged_neighbors_keep_mean_and_covariance(device, rng):
    """Twins merge; a stranger of another color and one far away stay."""
    case = Edited(device, rng, 4)
    means = np.array([[0, 0, 4], [0.01, 0, 4], [5, 0, 4], [5.01, 0, 4]], np.float32)
    colors = np.array([[0.2] * 3, [0.21] * 3, [0.2] * 3, [2.0] * 3], np.float32)
    case.gaussians.set("means", means)
    case.gaussians.set("sh_base", colors)
    case.gaussians.set("log_scales", np.log(np.full((4, 3), [0.05, 0.04, 0.03], np.float32)))
    case.gaussians.set("logit_opacity", np.array([[-1.0], [-1.5], [1.0], [0.0]], np.float32))
    before = {name: case.gaussians.get(name).astype(np.float64) for name in ("quats", "log_scales", "logit_opacity")}
    moments = {name: case.gaussians.get(f"adam/{name}/moment1") for name in ("means", "quats", "log_scales")}
    assert case.apply(MergeNeighbors()).after == 3
    tables = {**before, "means": means.astype(np.float64)}
    mass = masses(tables)[:2]
    weights = mass / mass.sum()
    mean = weights @ tables["means"][:2]
    own = covariance_matrices(before["quats"][:2], before["log_scales"][:2])
    offset = tables["means"][:2] - mean
    covariance = np.einsum("n,nij->ij", weights, own + offset[:, :, None] * offset[:, None, :])
    got = {name: case.gaussians.get(name).astype(np.float64) for name in (*before, "means", "sh_base")}
    np.testing.assert_allclose(got["means"][0], mean, atol=1e-6)
    np.testing.assert_allclose(covariance_matrices(got["quats"][:1], got["log_scales"][:1])[0], covariance, atol=1e-7)
    np.testing.assert_allclose(masses(got)[0], mass.sum(), rtol=1e-4)
    np.testing.assert_allclose(got["sh_base"][0], weights @ colors[:2], rtol=1e-5)
    after = {name: case.gaussians.get(f"adam/{name}/moment1") for name in moments}
    np.testing.assert_array_equal(after["means"][0], moments["means"][0])  # the heavier one's
    for name in ("quats", "log_scales"):
        assert (after[name][0] == 0).all(), "of axes that are no more"
        np.testing.assert_array_equal(after[name][1:], moments[name][2:])
    np.testing.assert_array_equal(got["means"][1:], means[2:])


@on_one_setting
def test_coincident_gaussians_merge(device, rng):
    case = Edited(device, rng, 40)
    for name in ("means", "sh_base"):
        case.gaussians.set(name, np.repeat(case.gaussians.get(name)[::2], 2, axis=0))
    assert case.apply(MergeNeighbors()).after == 20


@on_one_setting
def test_nothing_merges_where_a_mean_is_not_finite(device, rng):
    case = Edited(device, rng, 4)
    means = case.gaussians.get("means")
    means[1] = np.nan
    case.gaussians.set("means", means)
    assert case.apply(MergeNeighbors(distance_below=1e9, color_below=1e9)).after == 4


def test_merged_covariance_is_that_of_the_mixture(rng):
    count = 50
    tables = {
        "means": rng.normal(0, 1, (2 * count, 3)),
        "quats": rng.normal(size=(2 * count, 4)),
        "log_scales": rng.normal(-2, 1, (2 * count, 3)),
        "logit_opacity": rng.normal(0, 2, (2 * count, 1)),
        "sh_base": rng.normal(size=(2 * count, 3)),
        "sh_rest": rng.normal(size=(2 * count, 45)),
    }
    result = merge(tables, np.arange(count), np.arange(count, 2 * count))
    np.testing.assert_allclose(np.linalg.norm(result["quats"], axis=1), 1, rtol=1e-9)
    assert all(np.isfinite(values).all() for values in result.values())

    def mixture_of(values, rows):
        axes = Rotation.from_quat(np.roll(values["quats"][rows], -1, axis=1)).as_matrix()
        own = axes @ (np.exp(2 * values["log_scales"][rows])[:, :, None] * np.swapaxes(axes, 1, 2))
        volume = np.exp(values["log_scales"][rows].sum(axis=1))
        return values["means"][rows], own, volume / (1 + np.exp(-values["logit_opacity"][rows, 0]))

    halves = [mixture_of(tables, rows) for rows in (slice(0, count), slice(count, None))]
    total = sum(mass for _, _, mass in halves)
    mean = sum(mass[:, None] * mean for mean, _, mass in halves) / total[:, None]
    second = sum(mass[:, None, None] * (own + _outer(mean)) for mean, own, mass in halves) / total[:, None, None]
    got = mixture_of(result, slice(None))
    np.testing.assert_allclose(got[0], mean, rtol=1e-9)
    np.testing.assert_allclose(got[1], second - _outer(mean), atol=1e-9 * np.abs(second).max())


def _outer(means: np.ndarray) -> np.ndarray:
    return means[:, :, None] * means[:, None, :]
