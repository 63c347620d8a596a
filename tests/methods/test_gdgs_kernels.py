"""The rule that clones Gaussians in dense regions (gdgs.py), against loops over all of them."""

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.gaussians.gaussians import Gaussians
from clsplat.methods.adc import Clone
from clsplat.methods.gdgs import CloneDense, grid_cells
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam
from tests.support.devices import on_devices, on_one_setting

EXTENT = 2.0


def crowded(device: Device, rng, count: int) -> Gaussians:
    """Most lie in a corner of a wide cube; half have a large gradient, half are small."""
    case = random_case(rng, count)
    p = case.parameters
    p["means"][:] = np.where(rng.random((count, 1)) < 0.8, rng.uniform(0, 2, (count, 3)), rng.uniform(0, 8, (count, 3)))
    p["log_scales"][:] = np.log(EXTENT * rng.choice([0.005, 0.05], (count, 1))) + rng.normal(0, 0.1, (count, 3))
    gaussians = case.model(device).gaussians
    Adam(gaussians)
    SplatStats(gaussians)
    gaussians.set(SEEN, np.full((count, 1), 2.0))
    gaussians.set("stats/screen_grad", 2 * rng.choice([1e-4, 5e-4], (count, 1)))
    return gaussians


def apply(gaussians: Gaussians, *rules, limit: int | None = None, step: int = 700):
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(EXTENT), step=step, seed=4)
    return densify(edit, rules, Rasterizer(gaussians.device, "radix").tiler, limit)


def expected(before: dict[str, np.ndarray], cells: int, extremes: int) -> tuple[list[int], float]:
    """The Gaussians that are copied where the rule acts, and the ratio, one Gaussian after another."""
    means = before["means"].astype(np.float64)
    low, high = (np.array([np.quantile(means[:, k], share) for k in range(3)]) for share in (0.01, 0.99))
    members: dict[tuple[int, ...], list[int]] = {index: [] for index in np.ndindex(cells, cells, cells)}
    for n, mean in enumerate(means):
        if (mean < low).any() or (mean > high).any() or before["stats/screen_grad"][n, 0] / 2 < 2e-4:
            continue
        members[tuple(min(int(cells * x), cells - 1) for x in (mean - low) / np.maximum(high - low, 1e-9))].append(n)
    cells_by_number = sorted(members.values(), key=len, reverse=True)
    numbers = [len(cell) for cell in cells_by_number]
    small = np.exp(before["log_scales"].astype(np.float64)).max(axis=1) <= 0.01 * EXTENT
    chosen = sorted(n for cell in cells_by_number[:extremes] for n in cell if small[n])
    return chosen, sum(numbers[:extremes]) / max(sum(numbers[-extremes:]), 1)


@on_devices("count", [1, 17, 64, 65, 600])
def test_gaussians_in_the_fullest_cells_are_copied_and_moved(device, rng, count):
    gaussians = crowded(device, rng, count)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    chosen, _ = expected(before, 4, 20)
    change = apply(gaussians, CloneDense(ratio_above=0.0), Clone())
    small = np.exp(before["log_scales"]).max(axis=1) <= 0.01 * EXTENT
    steep = small & (before["stats/screen_grad"][:, 0] / 2 >= 2e-4)
    assert change.grown == {"clone_dense": len(chosen), "clone": steep.sum() - len(chosen)}
    assert count < 600 or (len(chosen) > 50 and change.grown["clone"] > 3)
    rows = np.where(steep, 2, 1)
    rows[chosen] = 3
    source = np.repeat(np.arange(count), rows)
    place = np.arange(len(source)) - np.repeat(np.cumsum(rows) - rows, rows)
    after = {name: gaussians.get(name) for name in gaussians.tables}
    for name in ("quats", "log_scales", "logit_opacity", "sh_base", "sh_rest"):
        np.testing.assert_array_equal(after[name], before[name][source])
    moved = place == 2
    np.testing.assert_array_equal(after["means"][~moved], before["means"][source][~moved])
    assert moved.sum() == len(chosen)
    offsets = (after["means"] - before["means"][source])[moved]
    noise = np.empty_like(offsets)
    for k, n in enumerate(source[moved]):
        rotation = ref.rotation_matrix(before["quats"][n].astype(np.float64))
        noise[k] = rotation.T @ offsets[k] / np.exp(before["log_scales"][n]) / 0.5
    if count == 600:
        assert np.abs(noise.mean(axis=0)).max() < 0.5
        np.testing.assert_allclose(np.cov(noise.T), np.eye(3), atol=0.6)


@on_one_setting
def test_rule_acts_above_its_ratio(device, rng):
    gaussians = crowded(device, rng, 600)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    chosen, ratio = expected(before, 3, 5)
    assert ratio > 2
    rule = {"cells": 3, "extremes": 5}
    assert apply(crowded(device, np.random.default_rng(0), 0), CloneDense(**rule)).after == 0
    assert apply(gaussians, CloneDense(ratio_above=ratio * 1.001, **rule)).after == 600
    for name in (SEEN, "stats/screen_grad"):  # an edit clears them
        gaussians.set(name, before[name])
    assert apply(gaussians, CloneDense(ratio_above=ratio * 0.999, **rule)).after == 600 + 2 * len(chosen)


@on_one_setting
def test_moves_depend_only_on_the_step(device, rng):
    state, results = rng.bit_generator.state, []
    for step in (700, 700, 800):
        rng.bit_generator.state = state
        gaussians = crowded(device, rng, 100)
        apply(gaussians, CloneDense(ratio_above=0.0), step=step)
        results.append(gaussians.get("means"))
    np.testing.assert_array_equal(results[0], results[1])
    assert (results[0] != results[2]).any()


@on_one_setting
def test_growth_stops_at_the_limit(device, rng):
    gaussians = crowded(device, rng, 300)
    means = gaussians.get("means")
    assert apply(gaussians, CloneDense(ratio_above=0.0), limit=301).after == 300, "none has room for two more"
    np.testing.assert_array_equal(gaussians.get("means"), means)


def test_cells_of_flat_and_broken_scenes():
    assert grid_cells(np.zeros((0, 3)), 4).shape == (0,)
    assert (grid_cells(np.ones((5, 3)), 4) == 0).all()
    flat = np.stack([np.linspace(0, 1, 101), np.zeros(101), np.zeros(101)], axis=1)
    result = grid_cells(flat, 4)
    assert (result[[0, 100]] == -1).all()
    assert result[1:100].tolist() == sorted(result[1:100])
    assert set(result[1:100]) == {0, 16, 32, 48}
    flat[50] = np.nan, 0, np.inf
    assert grid_cells(flat, 4)[50] == -1
    assert (grid_cells(np.full((3, 3), np.nan), 4) == -1).all()
