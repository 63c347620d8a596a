"""Relocation and noise of 3DGS-MCMC (mcmc.py, noise.cl) against the paper's equations in float64."""

import numpy as np
import pytest
from scipy.special import comb

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.methods.mcmc import Relocate, add_noise, divide_opacity, sample_systematically
from clsplat.pipeline.loading import load
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam
from tests.support.devices import each_once, on_devices, on_one_setting

SIZES = (0, 1, 15, 16, 17, 63, 64, 65, 150)  # around the sizes of vectors and groups


def opacities(gaussians: Gaussians) -> np.ndarray:
    return 1 / (1 + np.exp(-gaussians.get("logit_opacity")[:, 0].astype(np.float64)))


def some_gaussians(device, rng, count: int, faint: int, opacity=(0.2, 0.95)) -> Gaussians:
    """Gaussians of which the first are faint, with moments that are not zero."""
    case = random_case(rng, count)
    drawn = np.where(np.arange(count) < faint, 1e-3, rng.uniform(*opacity, count))
    case.parameters["logit_opacity"][:, 0] = np.log(drawn / (1 - drawn))
    gaussians = case.model(device).gaussians
    Adam(gaussians)
    for name in PARAMETERS:
        for moment in moment_tables(name):
            gaussians.set(moment, rng.uniform(1, 2, (count, gaussians.tables[moment].components)))
    return gaussians


def relocated(gaussians: Gaussians, limit: int | None = None, before=(), after=(), **settings) -> np.ndarray:
    """Apply the rule; return the old row of each new row, [M]."""
    colors = gaussians.get("sh_rest")
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3)
    rules = [*before, Relocate(**settings), *after]
    densify(edit, rules, Rasterizer(gaussians.device, "radix").tiler, limit)
    return np.array([int(np.flatnonzero((colors == row).all(axis=1))[0]) for row in gaussians.get("sh_rest")])


def shrinkage(opacity: float, new: float, copies: int) -> float:
    """Factor of the scales by eq. 9, as it is printed: a double sum, in float64."""
    total = 0.0
    for i in range(1, copies + 1):
        for k in range(i):
            total += comb(i - 1, k, exact=True) * (-1.0) ** k / np.sqrt(k + 1) * new ** (k + 1)
    return opacity / total


@on_devices("opacity", [0.3, 0.9, 1.0])
def test_sources_get_the_papers_opacity_and_scales(device, rng, opacity):
    """One opaque Gaussian, from which all copies come; the paper's formula holds to 50."""
    for copies in range(1, 52):
        count = max(2, copies)
        gaussians = some_gaussians(device, rng, count, faint=count - 1)
        logits, scales = gaussians.get("logit_opacity"), gaussians.get("log_scales")[-1]
        logits[-1] = 30.0 if opacity == 1.0 else np.log(opacity / (1 - opacity))
        gaussians.set("logit_opacity", logits)
        old = min(opacities(gaussians)[-1], 1 - 1e-7)
        source = relocated(gaussians, limit=copies, growth=1.0)
        assert source.tolist() == [count - 1] * copies
        number = min(copies, 50)
        new = max(1 - (1 - old) ** (1 / number), 0.005)
        np.testing.assert_allclose(opacities(gaussians), old if copies == 1 else new, rtol=1e-5)
        expected = scales + (0 if copies == 1 else np.log(shrinkage(old, new, number)))
        np.testing.assert_allclose(gaussians.get("log_scales"), np.tile(expected, (copies, 1)), atol=2e-5)


@on_devices("limit", [None, 1000, 155, 150, 140, 101, 100, 60])
def test_relocation_keeps_optical_depth_at_any_limit(device, rng, limit):
    """-ln(1 - opacity), summed over a source and its copies, is that of the source; no source fades without copies."""
    gaussians = some_gaussians(device, rng, 150, faint=50)
    depth = -np.log1p(-opacities(gaussians))
    source = relocated(gaussians, limit)
    target = 157 if limit is None else min(157, max(100, limit))
    assert gaussians.count == target
    sums = np.bincount(source, -np.log1p(-opacities(gaussians)), minlength=150)
    np.testing.assert_allclose(sums[50:], depth[50:], rtol=1e-5)
    assert (sums[:50] == 0).all()


class UndoEverySecondGrowth(Rule):
    """Let every second Gaussian that was to become several stay as it is."""

    def mark(self, edit: Edit) -> None:
        edit.undo_growth(np.arange(edit.gaussians.count) % 2 == 0)


@on_one_setting
def test_source_isolated_by_a_later_rule_does_not_change(device, rng):
    gaussians = some_gaussians(device, rng, 60, faint=30)
    before = {name: gaussians.get(name) for name in ("logit_opacity", "log_scales")}
    source = relocated(gaussians, after=[UndoEverySecondGrowth()])
    copies = np.bincount(source, minlength=60)
    alone = np.flatnonzero(copies[30:] == 1) + 30
    assert len(alone) > 10
    assert (copies[30:] > 1).any()
    rows = [int(np.flatnonzero(source == item)[0]) for item in alone]
    for name, table in before.items():
        np.testing.assert_array_equal(gaussians.get(name)[rows], table[alone])


@on_one_setting
def test_sources_and_copies_start_without_moments(device, rng):
    gaussians = some_gaussians(device, rng, 100, faint=20)
    before = gaussians.get("adam/means/moment1")
    source = relocated(gaussians)
    alone = np.bincount(source, minlength=100)[source] == 1
    assert 0 < alone.sum() < len(alone)
    expected = np.where(alone[:, None], before[source], 0)
    np.testing.assert_array_equal(gaussians.get("adam/means/moment1"), expected)


@on_one_setting
@pytest.mark.parametrize("limit", [None, 130])
def test_gaussians_selected_earlier_are_no_sources(device, rng, limit):
    class Take(Rule):
        def mark(self, edit: Edit) -> None:
            third = np.arange(100) // 20
            edit.choose(third == 1, copies=0, old_rows=0)
            edit.choose(third == 2, copies=2, old_rows=1)
            edit.choose(third == 0, copies=0, old_rows=0)

    gaussians = some_gaussians(device, rng, 100, faint=20)
    logits = gaussians.get("logit_opacity")[:, 0]
    source = relocated(gaussians, limit, before=[Take()], growth=1.2)
    copies = np.bincount(source, minlength=100)
    assert copies[:40].max() == 0
    assert (copies[40:60] == 2).all()
    np.testing.assert_array_equal(gaussians.get("logit_opacity")[source // 20 == 2, 0], np.repeat(logits[40:60], 2))
    assert gaussians.count == 100, "60 of the old, 20 copies of the first rule, 20 more by growth"


@on_one_setting
def test_nothing_changes_without_an_opaque_gaussian(device, rng):
    gaussians = some_gaussians(device, rng, 30, faint=30)
    before = gaussians.get("means")
    assert relocated(gaussians).tolist() == list(range(30))
    np.testing.assert_array_equal(gaussians.get("means"), before)


@on_devices("count, rate, below", each_once(SIZES, [(200.0, 0.005), (750.0, 0.3)]))
def test_noise_follows_the_formula(device, rng, count, rate, below):
    """Opacities on both sides of the gate, and above its reach; the same normal numbers in float64."""
    gaussians = some_gaussians(device, rng, count, faint=count // 2, opacity=(0.001, 0.6))
    before = {name: gaussians.get(name).astype(np.float64) for name in PARAMETERS}
    add_noise(gaussians, rate, below, seed=3, step=700)
    after = {name: gaussians.get(name) for name in PARAMETERS}
    opacity = 1 / (1 + np.exp(-before["logit_opacity"][:, 0]))
    gate = np.where(opacity > below + 0.1, 0, rate / (1 + np.exp(-100 * (below - opacity))))
    for i in range(count):
        axes = ref.rotation_matrix(before["quats"][i]) * np.exp(before["log_scales"][i])
        moved = gate[i] * axes @ axes.T @ ref.normal3((i, 700, 1, 0), (3, 0))
        largest = np.abs(np.append(before["means"][i], moved)).max()
        np.testing.assert_allclose(after["means"][i], before["means"][i] + moved, rtol=0, atol=1e-5 * largest)
    still = opacity > below + 0.1
    np.testing.assert_array_equal(after["means"][still], before["means"][still].astype(np.float32))
    assert count < 60 or np.abs(after["means"] - before["means"]).max() > 0.01
    for name in set(PARAMETERS) - {"means"}:
        np.testing.assert_array_equal(after[name], before[name].astype(np.float32), err_msg=name)


@pytest.mark.parametrize("recipe", ["mcmc", "mcmc_7k"])
def test_noise_scales_with_the_rate_of_the_means(recipe):
    training = load(recipe).settings.training
    noise = next(stage for stage in training.during if stage.stage == "add_noise")
    for step in (1, 3000, 6000):
        assert noise.rate.at(step) == pytest.approx(5e5 * training.rates.means.at(step))


@pytest.mark.parametrize(("draws", "count"), each_once([0, 1, 2, 7, 100, 1000], [1, 2, 63, 150]))
def test_systematic_draws_are_equally_spaced(rng, count, draws):
    """Against places on the line of weights one by one, in Python's whole numbers."""
    weights = rng.integers(0, 2**24, count).astype(np.uint64)
    weights[0], weights[-1] = 2**24, 1
    result = sample_systematically(weights, draws, np.random.default_rng(5))
    start, total, ends = (
        int(np.random.default_rng(5).integers(0, int(weights.sum()))),
        int(weights.sum()),
        weights.cumsum(),
    )
    expected = np.zeros(count, int)
    for j in range(draws):
        expected[np.searchsorted(ends, (j * total + start) // draws, side="right")] += 1
    np.testing.assert_array_equal(result, expected)
    assert result.sum() == draws
    share = draws * weights.astype(float) / total
    assert (np.abs(result - share) < 1 + 1e-9).all()


def test_positions_of_many_draws_do_not_overflow():
    """A hundred million weights of 2^24: their products are beyond 64 bits."""
    weights = np.full(3, 2**24 * 33_333_333, np.uint64)
    result = sample_systematically(weights, 2_000_003, np.random.default_rng(1))
    assert sorted(result) == [666667, 666668, 666668]


@pytest.mark.parametrize(("opacity", "rows"), each_once([0.05, 0.3, 0.73, 0.95, 0.999], [1, 2, 50, 20, 5]))
def test_coincident_rows_keep_the_center_and_the_integral(opacity, rows):
    """Equations 8 and 9: o at the center, and 1 - (1 - o' G(x / factor))^n has the integral of o G(x) over a line."""
    (new,), (factor,) = divide_opacity(np.array([opacity]), np.array([rows]), 1e-9)
    assert 1 - (1 - new) ** rows == pytest.approx(opacity, rel=1e-6)
    x = np.linspace(-40, 40, 200_001)
    together = 1 - (1 - new * np.exp(-((x / factor) ** 2) / 2)) ** rows
    alone = opacity * np.exp(-(x**2) / 2)
    assert together.sum() == pytest.approx(alone.sum(), rel=1e-4)


@on_one_setting
def test_relocation_keeps_the_image(device, rng):
    """One in twenty is faint, shows next to nothing, and becomes a copy of another: the picture stays, above 45 dB."""
    count = 300
    case = random_case(rng, count)
    opacity = np.where(np.arange(count) < count // 20, 1e-3, rng.uniform(0.2, 0.95, count))
    case.parameters["logit_opacity"][:, 0] = np.log(opacity / (1 - opacity))
    model, rasterizer = case.model(device), Rasterizer(device, "radix")
    Adam(model.gaussians)

    def picture() -> np.ndarray:
        frame = rasterizer.forward(model, case.device_camera(device), device.zeros(3))
        return frame.image.get()[:, : case.size[1], : case.size[0]].astype(np.float64)

    before = picture()
    edit = Edit(model.gaussians, SplatStats(model.gaussians), SceneScale(1.0), step=600, seed=3)
    densify(edit, [Relocate(growth=1.0)], rasterizer.tiler)
    assert model.gaussians.count == count
    assert before.std() > 0.05
    assert ref.psnr(picture(), before) > 45
