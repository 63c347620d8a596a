"""Growth and pruning by wrong pixels (fastgs.py) and draws without replacement, against the formulas in float64."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.scenes import Case, random_case, safe_case
from clsplat.core.errors import ConfigError
from clsplat.density.control import densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import sampling_order
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey, normalize
from clsplat.density.thresholds import SceneScale
from clsplat.methods.adc import Clone, SplitLarge
from clsplat.methods.fastgs import PruneInaccurate, PruneSampled, RevertGrowth, WrongPixels, count_wrong_pixels
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import each_once, on_devices, on_one_setting

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)


def surveyed(device: Device, case: Case, photographs: list[np.ndarray], masks: list | None = None) -> Survey:
    """A survey whose views have one camera and these photographs, [3, height, width] uint8."""
    camera = case.device_camera(device)
    held = [
        Photograph(camera, device.upload(colors), mask if mask is None else device.upload(mask[None].astype(np.uint8)))
        for colors, mask in zip(photographs, masks or [None] * len(photographs), strict=True)
    ]
    source = SimpleNamespace(get=lambda view: held[view], background=device.upload(BACKGROUND))
    return Survey(Rasterizer(device, "radix"), case.model(device), source, range(len(held)), seed=1, step=600)


def photo_folder(rng, case: Case, number: int) -> list[np.ndarray]:
    """The image of the reference, with errors in about half of the pixels."""
    image = ref.render(case.gaussians(), case.camera(), BACKGROUND.astype(np.float64), case.degree).image
    results = []
    for _ in range(number):
        error = rng.uniform(-0.3, 0.3, image.shape) * (rng.random(image.shape[1:]) < 0.5)
        results.append(np.round(255 * np.clip(image + error, 0, 1)).astype(np.uint8))
    return results


def expected_wrong(
    case: Case, photographs: list[np.ndarray], masks: list, above: float
) -> tuple[np.ndarray, np.ndarray]:
    """The formulas of the paper, pixel by pixel."""
    width, height = case.size
    image = ref.render(case.gaussians(), case.camera(), BACKGROUND.astype(np.float64), case.degree).image
    blended = ref.blend_weights(case.project(), width, height) > 0
    total, weighted = np.zeros(len(blended), int), np.zeros(len(blended))
    for colors, mask in zip(photographs, masks, strict=True):
        truth, counted = colors / 255, np.ones((height, width), bool) if mask is None else mask
        error = np.abs(image - truth).mean(axis=0)
        least, most = error[counted].min(), error[counted].max()
        share = (error - least) / (most - least)
        assert np.abs(share - above)[counted].min() > 1e-5, "a pixel at the threshold"
        number = (blended & counted & (share > above)).sum(axis=(1, 2))
        x, y = image * counted, truth * counted
        total += number
        weighted += (0.8 * ref.l1(x, y)[0] + 0.2 * ref.dssim(x, y)[0]) * number
    spread = weighted.max() - weighted.min()
    return total // len(photographs), (weighted - weighted.min()) / (spread or 1)


@on_devices(
    "count, width, height, masked", each_once([(1, 16, 16), (16, 17, 15), (17, 33, 31), (40, 24, 24)], [False, True])
)
def test_wrong_pixels_are_counted_exactly(device, rng, count, width, height, masked):
    case = safe_case(rng, count, width, height, MARGIN)
    photographs = photo_folder(rng, case, 4)
    masks = [rng.random((height, width)) < 0.7 if masked else None for _ in photographs]
    result = count_wrong_pixels(surveyed(device, case, photographs, masks), 10, 0.1)
    pixels, score = expected_wrong(case, photographs, masks, 0.1)
    np.testing.assert_array_equal(result.pixels, pixels)
    np.testing.assert_allclose(result.score, score, atol=1e-4)


@on_one_setting
def test_no_gaussians_or_errors_give_no_wrong_pixels(device, rng):
    case = random_case(rng, 0)
    result = count_wrong_pixels(surveyed(device, case, [np.zeros((3, 30, 40), np.uint8)]), 10, 0.1)
    assert result.pixels.shape == result.score.shape == (0,)
    case = random_case(rng, 3)
    case.parameters["logit_opacity"][:] = -30
    black = surveyed(device, case, [np.round(255 * BACKGROUND[:, None, None] * np.ones((3, 30, 40))).astype(np.uint8)])
    assert not count_wrong_pixels(black, 10, 0.1).score.any()


@on_one_setting
def test_number_of_rendered_views_is_limited(device, rng):
    case, asked = random_case(rng, 5), []
    survey = surveyed(device, case, [np.zeros((3, 30, 40), np.uint8)] * 12)
    held = survey._photographs.get
    survey._photographs.get = lambda view: (asked.append(view), held(view))[1]
    count_wrong_pixels(survey, 7, 0.1)
    assert asked == survey.sample_views(7)


def test_draws_pick_candidates_without_replacement(rng):
    candidates = np.array([True, False, True, True, False, True, True])
    order = sampling_order(candidates, np.array([1, np.inf, 0.0, 1, 5, 2, np.inf]), rng)
    assert sorted(order) == [0, 2, 3, 5, 6]
    assert (order[0], order[-1]) == (6, 2), "a weight without bound comes first, one of 0 last"


def test_draws_are_by_weight(rng):
    """Of three with the weights 1, 2 and 3, two at a time: against the probabilities of drawing one after another."""
    weights, draws = np.array([1.0, 2.0, 3.0]), 20_000
    last = np.bincount([sampling_order(np.ones(3, bool), weights, rng)[-1] for _ in range(draws)], minlength=3)
    expected = [2 / 6 * 3 / 4 + 3 / 6 * 2 / 3, 1 / 6 * 3 / 5 + 3 / 6 * 1 / 3, 1 / 6 * 2 / 5 + 2 / 6 * 1 / 4]
    np.testing.assert_allclose(last / draws, expected, atol=0.015)


def edit_of(device: Device, rng, count: int, wrong: WrongPixels, sizes=0.01, opacity=0.5) -> Edit:
    """An edit in which the survey finds what is given; every Gaussian is seen and pulled."""
    case = random_case(rng, count)
    case.parameters["log_scales"][:] = np.log(np.broadcast_to(sizes, count))[:, None]
    drawn = np.broadcast_to(opacity, count)
    case.parameters["logit_opacity"][:, 0] = np.log(drawn / (1 - drawn))
    gaussians = case.model(device).gaussians
    stats = SplatStats(gaussians)
    for name in ("stats/seen", "stats/screen_grad"):
        gaussians.set(name, np.ones((count, 1)))
    survey = SimpleNamespace(compute_once=lambda function, *arguments: wrong)
    return Edit(gaussians, stats, SceneScale(1.0), step=600, seed=3, survey=survey)


@on_one_setting
def test_growth_needs_wrong_pixels(device, rng):
    wrong = WrongPixels(np.array([0, 5, 6, 100, 5, 6]), np.zeros(6))
    edit = edit_of(device, rng, 6, wrong, sizes=np.repeat([0.001, 0.1], 3))
    rules = [Clone(size_below=0.01, opacity="shared"), SplitLarge(size_above=0.01), RevertGrowth(pixels_above=5)]
    logits, scales = edit.gaussians.get("logit_opacity"), edit.gaussians.get("log_scales")
    change = densify(edit, rules, Rasterizer(device, "radix").tiler)
    assert (change.after, change.causes) == (9, {"clone": 1, "split": 2, "revert_growth": 0})
    kept = [0, 1, 6]  # rows of the Gaussians 0, 1 and 4, which stay to the bit
    np.testing.assert_array_equal(edit.gaussians.get("logit_opacity")[kept], logits[[0, 1, 4]])
    np.testing.assert_array_equal(edit.gaussians.get("log_scales")[kept], scales[[0, 1, 4]])


@on_one_setting
def test_ungrown_gaussians_keep_their_size_for_later_rules(device, rng):
    """Split and undone: its own size counts for the removal of large ones, not that of its children."""
    edit = edit_of(device, rng, 2, WrongPixels(np.array([0, 9]), np.zeros(2)), sizes=0.12)
    prune = PruneSampled(share=1.0, size_above=0.1)
    densify(edit, [SplitLarge(size_above=0.01), RevertGrowth(), prune], Rasterizer(device, "radix").tiler)
    assert edit.gaussians.count == 2, "of 0.12, which goes, and of 0.12 / 1.6, twice"


@on_devices("faint", [0, 1, 7, 20])
def test_fraction_of_faint_and_large_gaussians_is_pruned(device, rng, faint):
    opacity = np.where(np.arange(40) < faint, 0.001, 0.5)
    sizes = np.where(np.arange(40) >= 35, 0.2, 0.01)  # five large ones
    edit = edit_of(device, rng, 40, WrongPixels(np.zeros(40, int), rng.random(40)), sizes, opacity)
    edit.rule = 2
    PruneSampled(share=0.5).mark(edit)
    removed = edit.row_counts() == 0
    assert removed.sum() == (faint + 5) // 2
    assert not removed[faint:35].any()
    again = edit_of(device, np.random.default_rng(0), 40, WrongPixels(np.zeros(40, int), np.zeros(40)), sizes, opacity)
    again.rule = 2
    PruneSampled(share=1.0).mark(again)
    assert (again.row_counts() == 0).sum() == faint + 5


@on_one_setting
def test_gaussians_with_wrong_pixels_are_pruned_first(device, rng):
    """Of two, one goes: weights 1 and 4, and the one with the largest score always."""
    counts = np.zeros(2)
    for seed in range(400):
        edit = edit_of(device, rng, 2, WrongPixels(np.zeros(2, int), np.array([0.0, 0.75])), opacity=0.001)
        edit.seed = seed
        PruneSampled(share=0.5).mark(edit)
        counts += edit.row_counts() == 0
    assert counts.sum() == 400
    assert counts[1] / 400 == pytest.approx(0.8, abs=0.06)
    edit = edit_of(device, rng, 3, WrongPixels(np.zeros(3, int), np.array([0.99, 1.0, 0.99])), opacity=0.001)
    PruneSampled(share=0.34).mark(edit)
    assert edit.row_counts().tolist() == [1, 0, 1]


@on_one_setting
def test_gaussians_with_large_scores_are_pruned_late(device, rng):
    edit = edit_of(device, rng, 4, WrongPixels(np.zeros(4, int), np.array([0.0, 0.9, 0.91, 1.0])))
    PruneInaccurate(score_above=0.9).mark(edit)
    assert edit.row_counts().tolist() == [1, 1, 0, 0]


@on_devices("rule", [RevertGrowth(), PruneSampled(), PruneInaccurate()])
def test_rules_without_images_raise_an_error(device, rng, rule: Rule):
    gaussians = random_case(rng, 4).model(device).gaussians
    with pytest.raises(ConfigError, match="needs training photos, but there are none"):
        rule.mark(Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3))


def test_values_are_scaled_between_the_valid_extremes():
    counted = np.array([True, True, False, True])
    assert normalize(np.array([2.0, 6.0, 100.0, 3.0]), counted)[counted].tolist() == [0, 1, 0.25]
    assert normalize(np.full(3, 7.0), np.ones(3, bool)).tolist() == [0, 0, 0]
    assert normalize(np.zeros(3), np.zeros(3, bool)).tolist() == [0, 0, 0]
