"""density.cl and gather.cl: statistics, rules, edits, and the rearrangement of every table."""

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.density.control import cap_opacity, densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.methods.adc import Clone, PruneFaint, PruneLarge, SplitLarge
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam
from tests.support.devices import each_once, on_devices, on_one_setting

RULES = [
    Clone(gradient_above=2e-4, size_below=0.01),
    SplitLarge(gradient_above=2e-4, size_above=0.01, children=2, shrink=1.6),
    PruneFaint(opacity_below=0.005),
    PruneLarge(size_above=0.1, start=3000),
]
EXTENT = 5.0
SCREEN_GRAD = "stats/screen_grad"


def edited(device: Device, rng, count: int, step: int, rules=RULES, limit: int | None = None):
    """Random Gaussians on both sides of every threshold, before and after densify."""
    case = random_case(rng, count)
    p = case.parameters
    p["log_scales"][:] = np.log(EXTENT * rng.choice([0.003, 0.03, 0.12, 0.4], (count, 1))) + rng.normal(
        0, 0.2, (count, 3)
    )
    p["logit_opacity"][:] = rng.choice([-7.0, -4.0, 2.0], (count, 1))
    gaussians = case.model(device).gaussians
    adam, stats = Adam(gaussians), SplatStats(gaussians)
    assert adam.gaussians is gaussians
    for name in PARAMETERS:
        for moment in ("moment1", "moment2"):
            table = f"adam/{name}/{moment}"
            gaussians.set(table, rng.uniform(1, 2, (count, gaussians.tables[table].components)))
    seen = rng.integers(0, 4, (count, 1)).astype(np.float32)
    mean = rng.choice([5e-5, 1e-3], (count, 1))
    gaussians.set(SCREEN_GRAD, seen * mean)
    gaussians.set(SEEN, seen)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    tiler = Rasterizer(device, "radix").tiler
    change = densify(Edit(gaussians, stats, SceneScale(EXTENT), step, seed=3), rules, tiler, limit)
    return before, gaussians, change


@on_devices("count, step", each_once([1, 15, 16, 17, 63, 64, 65, 300], [600, 3100]))
def test_adaptive_density_control(device, rng, count, step):
    before, gaussians, change = edited(device, rng, count, step)
    size = np.exp(before["log_scales"]).max(axis=1)
    opacity = 1 / (1 + np.exp(-before["logit_opacity"][:, 0]))
    gradient = ref.mean_gradient(before[SCREEN_GRAD][:, 0], before[SEEN][:, 0])
    action = ref.adc_actions(gradient, size, opacity, EXTENT, prune_large=step > 3000)
    rows = {ref.KEEP: 1, ref.CLONE: 2, ref.SPLIT: 2, ref.PRUNE: 0}
    source = np.repeat(np.arange(count), [rows[a] for a in action])
    place = np.concatenate([np.arange(rows[a]) for a in action]) if len(source) else np.zeros(0, int)
    split = action[source] == ref.SPLIT
    fresh = split | ((action[source] == ref.CLONE) & (place == 1))
    assert (change.before, change.after) == (count, len(source))
    assert gaussians.count == len(source)

    after = {name: gaussians.get(name) for name in gaussians.tables}
    for name in ("quats", "logit_opacity", "sh_base", "sh_rest", "filter_variance"):
        np.testing.assert_array_equal(after[name], before[name][source])
    for name in PARAMETERS:  # moments: kept rows keep theirs, fresh rows start at zero
        for moment in (f"adam/{name}/moment1", f"adam/{name}/moment2"):
            np.testing.assert_array_equal(after[moment], np.where(fresh[:, None], 0, before[moment][source]))
    np.testing.assert_array_equal(after["means"][~split], before["means"][source][~split])
    np.testing.assert_array_equal(after["log_scales"][~split], before["log_scales"][source][~split])
    np.testing.assert_allclose(after["log_scales"][split], before["log_scales"][source][split] - np.log(1.6), atol=1e-5)
    assert (after[SCREEN_GRAD] == 0).all()
    assert (after[SEEN] == 0).all()
    # children lie within their parent's distribution
    offsets = after["means"][split] - before["means"][source][split]
    sizes = size[source][split]
    assert (np.linalg.norm(offsets, axis=1) < 6 * sizes).all()


@on_devices("count, children", each_once([0, 1, 63, 64, 65, 300], [2, 3, 8]))
def test_shared_opacity_preserves_transmittance(device, rng, count, children):
    case = random_case(rng, count)
    logits = np.resize([-30.0, -5.0, 0.0, 2.0, 9.0, 40.0, 90.0], (count, 1)) + rng.normal(0, 0.1, (count, 1))
    case.parameters["logit_opacity"][:] = logits
    gaussians = case.model(device).gaussians
    stats = SplatStats(gaussians)
    for name in (SCREEN_GRAD, SEEN):
        gaussians.set(name, np.ones((count, 1)))
    large = np.exp(gaussians.get("log_scales")).max(axis=1) > 0.05
    rules = [Clone(size_below=0.05, opacity="shared"), SplitLarge(size_above=0.05, children=children, opacity="shared")]
    edit = Edit(gaussians, stats, SceneScale(1.0), step=700, seed=1)
    densify(edit, rules, Rasterizer(device, "radix").tiler)
    rows = np.where(large, children, 2)
    expected = [ref.shared_logit(np.float64(np.float32(one[0])), n) for one, n in zip(logits, rows, strict=True)]
    np.testing.assert_allclose(gaussians.get("logit_opacity")[:, 0], np.repeat(expected, rows), rtol=1e-5, atol=1e-5)


@on_one_setting
def test_undone_growth_keeps_the_opacities(device, rng):
    before, gaussians, change = edited(device, rng, 64, 600, rules=[Clone(opacity="shared")])
    assert change.after > 64
    before, gaussians, change = edited(device, rng, 64, 600, rules=[Clone(opacity="shared")], limit=64)
    assert change.after == 64
    np.testing.assert_array_equal(gaussians.get("logit_opacity"), before["logit_opacity"])


@pytest.mark.large
@on_one_setting
def test_children_follow_their_parents_distribution(device, rng):
    count = 4000
    case = random_case(rng, 1)
    p = {name: np.repeat(table, count, axis=0) for name, table in case.parameters.items()}
    p["log_scales"] = np.tile(np.log([0.5, 1.0, 0.2]).astype(np.float32), (count, 1))
    gaussians = Gaussians(device, p)
    stats = SplatStats(gaussians)
    for name in (SCREEN_GRAD, SEEN):
        gaussians.set(name, np.ones((count, 1)))
    edit = Edit(gaussians, stats, SceneScale(1.0), step=700, seed=1)
    densify(edit, [SplitLarge(size_above=1e-6)], Rasterizer(device, "radix").tiler)
    assert gaussians.count == 2 * count
    q = p["quats"][0].astype(np.float64)
    rotation = ref.rotation_matrix(q / np.linalg.norm(q))
    noise = (gaussians.get("means") - p["means"][0]) @ rotation / [0.5, 1.0, 0.2]
    assert np.abs(noise.mean(axis=0)).max() < 0.05
    np.testing.assert_allclose(np.cov(noise.T), np.eye(3), atol=0.06)


@on_one_setting
def test_random_numbers_depend_only_on_seed_and_step(device, rng):
    seed_state = rng.bit_generator.state
    results = []
    for step in (600, 600, 700):
        rng.bit_generator.state = seed_state
        _, gaussians, _ = edited(device, rng, 100, step)
        results.append(gaussians.get("means"))
    np.testing.assert_array_equal(results[0], results[1])
    assert (results[0] != results[2]).any()


@on_one_setting
def test_all_gaussians_may_be_pruned(device, rng):
    _, gaussians, change = edited(device, rng, 30, 600, rules=[PruneFaint(opacity_below=1.0)])
    assert change.after == 0
    assert gaussians.get("means").shape == (0, 3)


@on_one_setting
def test_capacity_grows_when_needed(device, rng):
    _, gaussians, change = edited(
        device, rng, 64, 600, rules=[SplitLarge(gradient_above=1e-12, size_above=1e-9, children=8)]
    )
    assert change.after > 64
    assert gaussians.capacity >= change.after
    assert gaussians.capacity % 64 == 0


@on_one_setting
def test_identity_rearrangement_changes_nothing(device, rng):
    gaussians = random_case(rng, 50).model(device).gaussians
    before = {name: gaussians.get(name) for name in gaussians.tables}
    same = device.upload(np.arange(50, dtype=np.uint32))
    gaussians.rearrange(same, device.zeros(50, np.uint32), 50)
    for name, table in before.items():
        np.testing.assert_array_equal(gaussians.get(name), table)


@on_devices("count", [0, 63, 64])
def test_opacity_is_capped(device, rng, count):
    gaussians = random_case(rng, count).model(device).gaussians
    before = gaussians.get("logit_opacity")
    cap_opacity(gaussians, 0.3)
    np.testing.assert_allclose(gaussians.get("logit_opacity"), np.minimum(before, np.log(0.3 / 0.7)), rtol=1e-6)


def test_opacity_is_capped_after_the_world_filter(device, rng):
    """No filter leaves the limit itself, a strong one leaves everything as it is."""
    case = add_world_filter(random_case(rng, 300), rng)
    case.parameters["filter_variance"][:3] = np.array([[0], [1e6], [1e-30]])
    case.parameters["log_scales"][2] = -60  # underflows
    case.parameters["logit_opacity"][:3] = 4
    gaussians = case.model(device).gaussians
    cap_opacity(gaussians, 0.3)
    after = gaussians.get("logit_opacity")[:, 0].astype(np.float64)
    oracle = case.gaussians()
    scale2 = np.exp(2 * oracle.log_scales)
    ratio = np.prod(np.sqrt(scale2 / (scale2 + oracle.filter_variance[:, None])), axis=1)
    expected = np.minimum(oracle.logit_opacity, 99)
    capped = ratio / (1 + np.exp(-expected)) > 0.3
    expected[capped] = ref.reset_logit(expected[capped], ratio[capped], 0.3)
    assert 20 < capped.sum() < 280
    np.testing.assert_allclose(after, expected, rtol=2e-5, atol=2e-5)
    assert (ratio / (1 + np.exp(-after)) <= 0.3 * (1 + 1e-5)).all()


@on_devices("value", [np.nan, np.inf, -np.inf])
def test_nonfinite_values_are_detected(device, rng, value):
    case = random_case(rng, 65)
    assert case.model(device).gaussians.find_nonfinite() == []
    case.parameters["quats"][64, 2] = value
    case.parameters["sh_rest"][0, 44] = value
    gaussians = case.model(device).gaussians
    assert gaussians.find_nonfinite() == ["quats", "sh_rest"]
    for table in moment_tables("means"):
        gaussians.add(table, 3)
    assert gaussians.find_nonfinite() == ["quats", "sh_rest"]
    gaussians[moment_tables("means")[1]].fill(value)
    assert gaussians.find_nonfinite() == ["means", "quats", "sh_rest"]
