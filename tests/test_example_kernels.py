"""relocation.cl, box_blur.cl and the equations of relocation.py against NumPy in float64."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import comb

import clsplat
from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.gaussians.tables import PARAMETERS, Gaussians, moment_tables
from clsplat.pipeline.loading import load
from clsplat.render.rasterizer import Rasterizer
from clsplat.settings import variants
from clsplat.stages.base import Stage
from clsplat.training.adam import Adam
from clsplat.views.transforms import PhotographTransform
from tests.kernels.test_blur import colours_of, planes_of

EXAMPLES = Path(__file__).parents[1] / "examples"
SIZES = (1, 15, 16, 17, 63, 64, 65, 150)  # around the sizes of vectors and groups


@pytest.fixture(autouse=True)
def loaded(without_plugins) -> None:
    """The two examples as plug-ins."""
    for name in ("relocation", "box_blur"):
        clsplat.load_plugin(EXAMPLES / f"{name}.py")


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


def relocated(gaussians: Gaussians, limit: int | None = None, before=(), **settings) -> np.ndarray:
    """Apply the rule; return the old row of each new row, [M]."""
    colours = gaussians.get("sh_rest")
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3)
    rules = [*before, variants(Rule)["relocate"](**settings)]
    densify(edit, rules, Rasterizer(gaussians.device, "radix").tiler, limit)
    return np.array([int(np.flatnonzero((colours == row).all(axis=1))[0]) for row in gaussians.get("sh_rest")])


def shrinkage(opacity: float, new: float, copies: int) -> float:
    """Factor of the scales by eq. 9, as it is printed: a double sum, in float64."""
    total = 0.0
    for i in range(1, copies + 1):
        for k in range(i):
            total += comb(i - 1, k, exact=True) * (-1.0) ** k / np.sqrt(k + 1) * new ** (k + 1)
    return opacity / total


@pytest.mark.parametrize("opacity", [0.3, 0.9, 1.0])
def test_sources_get_the_opacity_and_the_scales_of_the_paper(device, rng, opacity):
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


@pytest.mark.parametrize("limit", [None, 1000, 155, 150, 140, 101, 100, 60])
def test_relocation_keeps_the_optical_depth_whatever_the_limit(device, rng, limit):
    """-ln(1 - opacity), summed over a source and its copies, is that of the source; no source fades without copies."""
    gaussians = some_gaussians(device, rng, 150, faint=50)
    depth = -np.log1p(-opacities(gaussians))
    source = relocated(gaussians, limit)
    target = 157 if limit is None else min(157, max(100, limit))
    assert gaussians.count == target
    sums = np.bincount(source, -np.log1p(-opacities(gaussians)), minlength=150)
    np.testing.assert_allclose(sums[50:], depth[50:], rtol=1e-5)
    assert (sums[:50] == 0).all()


def test_sources_and_copies_start_without_moments(device, rng):
    gaussians = some_gaussians(device, rng, 100, faint=20)
    before = gaussians.get("adam/means/moment1")
    source = relocated(gaussians)
    alone = np.bincount(source, minlength=100)[source] == 1
    assert 0 < alone.sum() < len(alone)
    expected = np.where(alone[:, None], before[source], 0)
    np.testing.assert_array_equal(gaussians.get("adam/means/moment1"), expected)


@pytest.mark.parametrize("limit", [None, 130])
def test_gaussians_that_an_earlier_rule_took_are_no_sources(device, rng, limit):
    class Take(Rule):
        def mark(self, edit: Edit) -> None:
            third = np.arange(100) // 20
            edit.choose(third == 1, copies=0, kept=0)
            edit.choose(third == 2, copies=2, kept=1)
            edit.choose(third == 0, copies=0, kept=0)

    gaussians = some_gaussians(device, rng, 100, faint=20)
    logits = gaussians.get("logit_opacity")[:, 0]
    source = relocated(gaussians, limit, before=[Take()], growth=1.2)
    copies = np.bincount(source, minlength=100)
    assert copies[:40].max() == 0
    assert (copies[40:60] == 2).all()
    np.testing.assert_array_equal(gaussians.get("logit_opacity")[source // 20 == 2, 0], np.repeat(logits[40:60], 2))
    assert gaussians.count == 100, "60 of the old, 20 copies of the first rule, 20 more by growth"


def test_without_an_opaque_gaussian_nothing_changes(device, rng):
    gaussians = some_gaussians(device, rng, 30, faint=30)
    before = gaussians.get("means")
    assert relocated(gaussians).tolist() == list(range(30))
    np.testing.assert_array_equal(gaussians.get("means"), before)


def philox(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox 4x32-10 (Salmon et al. 2011) in Python integers.  counter: [N, 4]; returns [N, 4]."""
    words, result = 2**32, []
    for start in counter.tolist():
        (a, b, c, d), (k0, k1) = start, key
        for _ in range(10):
            first, second = 0xD2511F53 * a, 0xCD9E8D57 * c
            a, b, c, d = second // words ^ b ^ k0, second % words, first // words ^ d ^ k1, first % words
            k0, k1 = (k0 + 0x9E3779B9) % words, (k1 + 0xBB67AE85) % words
        result.append((a, b, c, d))
    return np.array(result, np.int64)


def normal_numbers(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Three standard normal numbers for each counter, [N, 3] (Box and Muller 1958)."""
    u = ((philox(counter, key) >> 8) + 1) / 2**24
    radius, angle = np.sqrt(-2 * np.log(u[:, [0, 2]])), 2 * np.pi * u[:, [1, 3]]
    return np.stack(
        [radius[:, 0] * np.cos(angle[:, 0]), radius[:, 0] * np.sin(angle[:, 0]), radius[:, 1] * np.cos(angle[:, 1])], 1
    )


def test_the_reference_gives_the_published_random_numbers():
    """The known answers that the authors publish (Random123)."""
    zeros, ones = philox(np.zeros((1, 4), np.int64), (0, 0)), philox(np.full((1, 4), 2**32 - 1), (2**32 - 1,) * 2)
    assert [hex(word) for word in zeros[0]] == ["0x6627e8d5", "0xe169c58d", "0xbc57ac4c", "0x9b00dbd8"]
    assert [hex(word) for word in ones[0]] == ["0x408f276d", "0x41c83b0e", "0xa20bc7c6", "0x6d5451fd"]


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("settings", [{}, {"rate": 300.0, "opacity_below": 0.3}])
def test_the_noise_is_that_of_the_formula(device, rng, count, settings):
    """Opacities on both sides of the gate; the same normal numbers in float64."""
    gaussians = some_gaussians(device, rng, count, faint=count // 2, opacity=(0.001, 0.4))
    before = {name: gaussians.get(name).astype(np.float64) for name in PARAMETERS}
    stage = variants(Stage)["add_noise"](**settings)
    run = SimpleNamespace(
        model=SimpleNamespace(gaussians=gaussians),
        scene=SimpleNamespace(extent=2.5),
        device=device,
        seed=3,
        step=700,
    )
    stage.run(run)
    after = {name: gaussians.get(name) for name in PARAMETERS}
    counter = np.array([[i, 700, 1, 0] for i in range(count)])
    rate, below = settings.get("rate", 80.0) * 2.5, settings.get("opacity_below", 0.005)
    gate = rate / (1 + np.exp(-100 * (below - 1 / (1 + np.exp(-before["logit_opacity"])))))
    quats = before["quats"] / np.linalg.norm(before["quats"], axis=1, keepdims=True)
    rotations = np.stack([ref.rotation_matrix(q) for q in quats])
    covariance = np.einsum("nij,nj,nkj->nik", rotations, np.exp(2 * before["log_scales"]), rotations)
    noise = gate * np.einsum("nij,nj->ni", covariance, normal_numbers(counter, (3, 0)))
    np.testing.assert_allclose(after["means"], before["means"] + noise, rtol=1e-4, atol=1e-5)
    assert count < 60 or np.abs(noise).max() > 0.01
    for name in set(PARAMETERS) - {"means"}:
        np.testing.assert_array_equal(after[name], before[name].astype(np.float32), err_msg=name)


def window_mean(image: np.ndarray, reach: int) -> np.ndarray:
    """Mean of the window around each pixel, as far as it lies inside the image.  image: [3, H, W]."""
    _, height, width = image.shape
    result = np.empty_like(image)
    for y in range(height):
        for x in range(width):
            window = image[:, max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
            result[:, y, x] = window.mean(axis=(1, 2))
    return result


@pytest.mark.parametrize("reach", [0, 0.4, 1, 2.6, 4, 80])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 3), (15, 4), (16, 16), (17, 5), (33, 18), (64, 2), (65, 7)])
def test_the_box_blur_is_the_mean_of_a_window(device, rng, width, height, reach):
    image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    transform = variants(PhotographTransform)["box_blur"](reach=reach)
    found = colours_of(transform.apply(planes_of(device, image), step=1))
    np.testing.assert_allclose(found, window_mean(image.astype(np.float64), round(reach)), rtol=1e-5)


def test_the_noise_of_the_example_follows_the_rate_of_the_means():
    training = load(str(EXAMPLES / "relocation.yaml")).settings.training
    noise = next(stage for stage in training.during if stage.stage == "add_noise")
    for step in (1, 3000, 6000):
        assert noise.rate.at(step) == pytest.approx(5e5 * training.rates.means.at(step))
