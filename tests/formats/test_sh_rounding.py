"""Rounding of harmonics by weights and visible errors, against a slow reference, in SPZ and SOG."""

import gzip
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.core.harmonics import basis, mean_basis
from clsplat.formats import sog_quantize
from clsplat.formats.packing import morton_order
from clsplat.formats.sog_quantize import (
    MAX_LOG_WEIGHT,
    SH_LEVELS,
    compensate_base,
    fit_tree_palette,
    is_before_gap,
    log_weights,
    quantization_steps,
    round_sh,
    scaled_step,
    visible_form,
)
from clsplat.formats.splats import SH_C0, SplatFile, WriteOptions, normalize_quats
from clsplat.formats.table import read, write
from clsplat.gaussians.conversion import with_sky_splats
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.sky import Sky
from tests.support.models import round_trip, splats


def one_sided_model(rng: np.random.Generator, count: int, degree: int = 3) -> SplatFile:
    """A model whose harmonics lie mostly along a few directions, as those of cameras on one side do."""
    source = splats(rng, count, degree)
    coefficients = source.parameters["sh_rest"].shape[1] // 3
    few = rng.normal(0, 0.1, (3, coefficients))
    rest = np.einsum("nfc,fk->nkc", rng.normal(size=(count, 3, 3)), few) + rng.normal(0, 0.01, (count, coefficients, 3))
    source.parameters["sh_rest"] = rest.reshape(count, -1).astype(np.float32)
    source.parameters["log_scales"] = rng.uniform(-6, -3, (count, 3)).astype(np.float32)
    return source


def visible_error(error: np.ndarray, form: np.ndarray) -> np.ndarray:
    """Visible error of each Gaussian, e^T G e summed over channels, [N]."""
    channels = error.astype(np.float64).reshape(len(error), len(form), 3)
    return np.einsum("nkc,kl,nlc->n", channels, form, channels)


def covariances(one: SplatFile) -> np.ndarray:
    """Of each Gaussian, [N, 3, 3]."""
    w, x, y, z = normalize_quats(one.parameters["quats"]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turned = np.moveaxis(np.array(rows), 2, 0) * np.exp(one.parameters["log_scales"].astype(np.float64))[:, None]
    return turned @ turned.transpose(0, 2, 1)


def test_weights_ignore_scene_size_and_grow_with_opacity_area(rng):
    p = splats(rng, 200).parameters
    result = log_weights(p)
    larger = {**p, "means": 10 * p["means"], "log_scales": p["log_scales"] + np.float32(np.log(10))}
    np.testing.assert_allclose(log_weights(larger), result, atol=1e-5)
    assert abs(np.median(result)) < 1e-9
    more = {name: table.copy() for name, table in p.items()}
    middle = np.argsort(result)[90:110]
    more["logit_opacity"][middle[0]] += 1
    more["log_scales"][middle[1]] += 0.5
    after = log_weights(more)
    changed = after - result - np.median(after - result)
    assert (changed[middle[:2]] > 0.1).all()


@pytest.mark.parametrize("count", [400, 3000])
def test_sky_gaussians_do_not_decide_the_rounding(count, rng, tmp_path):
    """Of the scene: its weights, and the errors of its positions in files."""
    source, texels = splats(rng, count), rng.uniform(0, 1, (64, 3)).astype(np.float32)
    source.parameters["log_scales"] = rng.uniform(-3.5, -3, (count, 3)).astype(np.float32)
    baked = with_sky_splats(Model(**source.parameters, sky=Sky(texels)), 5000)
    behind = baked.to_splat_file()
    assert behind.has_sky
    alone, beside = log_weights(source.parameters), log_weights(behind.parameters, has_sky=True)[:count]
    np.testing.assert_allclose(beside, alone, atol=0.15)
    for name in ("a.spz", "a.sog"):
        errors = []
        for item in (source, behind):
            actual = round_trip(tmp_path / name, item).parameters["means"]
            errors.append(np.median(cKDTree(actual).query(source.parameters["means"])[0]))
        assert errors[1] < 1.3 * errors[0], name


def test_model_without_sky_counts_all_gaussians(rng, tmp_path):
    """Most Gaussians in a small object, the others far around it: no sky, where the file notes none."""
    source = splats(rng, 2300, 0)
    directions, radii = rng.normal(size=(2300, 3)), np.append(rng.uniform(0, 0.1, 2000), rng.uniform(2, 3, 300))
    source.parameters["means"] = normalize_quats(np.pad(directions, ((0, 0), (1, 0))))[:, 1:] * radii[:, None].astype(
        np.float32
    )
    source.parameters["means"] = source.parameters["means"].astype(np.float32)
    assert not is_before_gap(radii).all()
    assert abs(np.median(log_weights(source.parameters))) < 1e-9
    noted = replace(source, rendering={"sky": "splats"})
    for name in ("a.spz", "a.sog"):
        actual = [round_trip(tmp_path / name, item).parameters["means"] for item in (source, noted)]
        assert (actual[0] != actual[1]).any(), name


def test_sky_is_recognized_in_a_converted_ply(rng, tmp_path):
    source, texels = splats(rng, 300, 1), rng.uniform(0, 1, (64, 3)).astype(np.float32)
    baked = with_sky_splats(Model(**source.parameters, sky=Sky(texels)), 5000)
    baked.save(tmp_path / "a.ply")
    for name in ("a.spz", "a.sog"):
        assert load(tmp_path / "a.ply").save(tmp_path / name) == baked.save(tmp_path / f"direct_{name}")


def test_all_gaussians_count_without_a_gap(rng):
    for power in (1, 2, 4):
        assert is_before_gap(rng.uniform(0, 1, 2000) ** power).all()
    few = np.append(rng.uniform(0, 1, 980), rng.uniform(40, 50, 20))
    assert is_before_gap(few).all(), "too few to decide a median"
    assert is_before_gap(np.zeros(50)).all()
    assert is_before_gap(np.array([0.0, 1.0])).all()
    sky = np.append(rng.uniform(0, 1, 300), np.full(700, 10.0))
    np.testing.assert_array_equal(is_before_gap(sky), sky < 5)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_weights_are_finite_of_any_model(count, rng):
    p = splats(rng, count).parameters
    for name, value in (("logit_opacity", -1e30), ("logit_opacity", 1e30), ("log_scales", 1e15), ("means", 1e15)):
        p[name][: count // 2] = value
        assert np.isfinite(log_weights(p)).all()
        assert (np.abs(log_weights(p)) <= MAX_LOG_WEIGHT).all()
    p["means"][:] = 3
    assert np.isfinite(log_weights(p)).all()


def test_steps_are_proportional_to_root_weights(rng):
    result = quantization_steps(np.array([-20.0, -4, -2, 0, 2, 4, 6]), 4, 64)
    np.testing.assert_array_equal(result, [64, 16, 8, 4, 2, 1, 1])


@pytest.mark.parametrize("count", [1, 50])
def test_rounding_matches_the_reference(count, rng):
    """The reference solves for what the rest of the coefficients should take up, one coefficient after another."""
    rest = one_sided_model(rng, count).parameters["sh_rest"]
    form, step = visible_form(rest), np.exp2(rng.integers(-7, -2, count)).astype(np.float32)
    expected = np.empty(rest.shape)
    for row in range(count):
        for channel in range(3):
            wanted = rest[row, channel::3].astype(np.float64)
            for k in reversed(range(15)):
                value = np.rint(wanted[k] / step[row]) * step[row]
                change = np.linalg.solve(form[:k, :k], form[:k, k]) * (wanted[k] - value)
                wanted[:k] += change
                wanted[k] = value
            expected[row, channel::3] = wanted
    result = round_sh(rest, step, form)
    assert (np.abs(result - expected) > 1e-6).any(axis=1).mean() < 0.05  # a tie of float32 is none of float64


def test_joint_rounding_is_less_visible_than_independent(rng):
    rest = one_sided_model(rng, 400).parameters["sh_rest"]
    step = np.full(400, 1 / 32, np.float32)
    form = visible_form(rest)
    result, alone = round_sh(rest, step, form), np.rint(rest / step[:, None]) * step[:, None]
    np.testing.assert_array_equal(result, np.rint(result * 32) / 32)
    assert visible_error(result - rest, form).sum() < 0.4 * visible_error(alone - rest, form).sum()
    np.testing.assert_array_equal(round_sh(rest, step, np.eye(15)), alone)


@pytest.mark.parametrize("rows", [7, 64])
def test_rounding_is_the_same_in_any_blocks(rows, rng, monkeypatch):
    rest = one_sided_model(rng, 150, 2).parameters["sh_rest"]
    step = np.full(150, 1 / 32, np.float32)
    form = visible_form(rest)
    table = rest.astype(np.float64).reshape(150, 8, 3)
    moments = np.einsum("nkc,nlc->kl", table, table)
    expected = 8 * moments / np.trace(moments) + sog_quantize.ISOTROPIC * np.eye(8)
    np.testing.assert_allclose(form, expected, atol=0.02)
    result = round_sh(rest, step, form)
    monkeypatch.setattr(sog_quantize, "ROWS", rows)
    np.testing.assert_array_equal(visible_form(rest), form)
    np.testing.assert_array_equal(round_sh(rest, step, form), result)
    assert np.isfinite(round_sh(0 * rest, step, visible_form(0 * rest))).all()


@pytest.mark.parametrize("count", [3, 8, 15])
def test_harmonics_mean_follows_from_second_moments(count, rng):
    """Products of one band with itself are even, so that those of band 1 alone tell nothing of its mean."""
    directions = rng.normal((0, 1, 2), size=(50, 3))
    values = basis(directions / np.linalg.norm(directions, axis=1, keepdims=True))[:, :count]
    expected = values.mean(axis=0) if count > 3 else np.zeros(3)
    for scale in (1, 7):
        np.testing.assert_allclose(mean_basis(scale * values.T @ values), expected, atol=2e-6)
    np.testing.assert_allclose(mean_basis(np.eye(count)), 0, atol=2e-6)
    form = rng.normal(size=(count, count))
    form = form @ form.T  # of no directions
    mean, moments = mean_basis(form), form * (count / (4 * np.pi) / np.trace(form))
    assert mean @ np.linalg.solve(moments, mean) < 1.001


def test_band_0_absorbs_the_view_independent_part(rng):
    """The least squares of colors over the directions themselves."""
    directions = rng.normal((0, 0, 2), size=(40, 3))
    values = basis(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    base, lacking = rng.normal(size=(20, 3)), rng.normal(0, 0.1, (20, 15, 3))
    result = compensate_base(base, lacking.reshape(20, 45), values.T @ values)
    colors = np.einsum("dk,nkc->ndc", values, lacking)
    np.testing.assert_allclose((result - base) * SH_C0, colors.mean(axis=1), atol=1e-5)


def test_spz_steps_grow_as_weights_fall(tmp_path, rng):
    source = one_sided_model(rng, 500)
    actual = round_trip(tmp_path / "a.spz", source).parameters
    levels = 128 * actual["sh_rest"]
    np.testing.assert_array_equal(levels, np.rint(levels))
    expected = np.sort(
        quantization_steps(log_weights(source.parameters), scaled_step(source.parameters["sh_rest"], 3, 5), 64)
    )
    np.testing.assert_array_equal(levels, np.rint(levels / expected[:, None]) * expected[:, None])
    assert len(np.unique(expected)) > 4
    write(tmp_path / "high.spz", source, WriteOptions(quality="high"))
    assert (tmp_path / "a.spz").stat().st_size < 0.8 * (tmp_path / "high.spz").stat().st_size
    exact = source.rows(morton_order(source.parameters["means"])).parameters["sh_rest"]
    given = read(tmp_path / "high.spz").parameters["sh_rest"]
    within = np.abs(exact) < 127 / 128  # others are cut
    assert np.abs(given - exact)[within].max() <= 1 / 256


def test_spz_steps_depend_on_each_gaussians_weight(tmp_path, rng):
    source = one_sided_model(rng, 500)
    source.parameters["log_scales"] += rng.uniform(-3, 3, (500, 1)).astype(np.float32)
    actual = round_trip(tmp_path / "a.spz", source).parameters
    p = source.rows(morton_order(source.parameters["means"])).parameters
    own = np.argsort(quantization_steps(log_weights(p), scaled_step(p["sh_rest"], 3, 5), 64), kind="stable")
    p = {name: table[own] for name, table in p.items()}
    weights = log_weights(p)[:, None]
    base = compensate_base(p["sh_base"], p["sh_rest"] - actual["sh_rest"], visible_form(p["sh_rest"]))
    step = quantization_steps(weights, 2**0.5, 16)
    levels = 255 * (0.15 * actual["sh_base"].astype(np.float64) + 0.5)
    np.testing.assert_allclose(levels, np.rint(levels / step) * step, atol=1e-3)
    assert (np.abs(actual["sh_base"] - base) <= step / 2 / 255 / 0.15 + 1e-5).all()
    assert np.abs(base - p["sh_base"]).max() > 0.05, "errors of harmonics are large enough to tell"
    largest = np.exp(p["log_scales"].min(axis=1, keepdims=True)) / 4 * np.exp2(-weights / 2)  # half a step
    assert (np.abs(actual["means"] - p["means"]) <= np.maximum(largest, 2**-13) * 1.0001).all()


def test_spz_positions_and_rotations_are_within_their_steps(tmp_path, rng):
    source = splats(rng, 300, 0)
    copy, expected = round_trip(tmp_path / "a.spz", source), source.rows(morton_order(source.parameters["means"]))
    smallest = np.exp(expected.parameters["log_scales"].min(axis=1, keepdims=True))
    away = np.abs(copy.parameters["means"] - expected.parameters["means"])
    largest = smallest / 4 * np.exp2(-log_weights(expected.parameters)[:, None] / 2)  # half a step
    assert (away <= np.maximum(largest, 2**-13) * 1.0001).all()
    assert (away > smallest / 4).any(), "where weights are small, steps are larger"
    cosine = np.abs(
        (normalize_quats(copy.parameters["quats"]) * normalize_quats(expected.parameters["quats"])).sum(axis=1)
    )
    assert np.degrees(2 * np.arccos(np.minimum(cosine, 1))).max() < 0.7


def test_spz_gzip_is_readable_by_other_programs(tmp_path, rng):
    for degree in (0, 3):
        write(tmp_path / "a.spz", splats(rng, 200, degree))
        assert len(gzip.decompress((tmp_path / "a.spz").read_bytes())) == 16 + 200 * (20 + 3 * ((degree + 1) ** 2 - 1))


@pytest.mark.parametrize(("count", "entries"), [(1, 1), (40, 40), (700, 30), (1500, 300)])
def test_neighbor_palette_holds_the_means_of_its_clusters(count, entries, rng):
    rest = one_sided_model(rng, count).parameters["sh_rest"]
    weights = rng.normal(size=count)
    vectors, labels = fit_tree_palette(rest, weights, entries, 1.0)
    assert len(vectors) <= entries
    np.testing.assert_array_equal(np.unique(labels), np.arange(len(vectors)))
    sums = np.zeros((len(vectors), 45))
    np.add.at(sums, labels, np.exp2(weights)[:, None] * rest)
    means = sums / np.bincount(labels, np.exp2(weights))[:, None]
    np.testing.assert_allclose(np.rint(vectors * SH_LEVELS), vectors * SH_LEVELS)
    assert np.abs(vectors - means).mean() < 16 / SH_LEVELS
    for _ in range(2):
        np.testing.assert_array_equal(fit_tree_palette(rest, weights, entries, 1.0)[1], labels)


def test_neighbor_palette_favors_heavier_gaussians(rng):
    rest = one_sided_model(rng, 2000).parameters["sh_rest"]
    weights = np.where(np.arange(2000) % 4 == 0, 3.0, -3.0)
    vectors, labels = fit_tree_palette(rest, weights, 400, 2.0)
    errors = visible_error(vectors[labels] - rest, visible_form(rest))
    assert errors[::4].mean() < 0.3 * errors[weights < 0].mean()
    same = np.tile(rest[:1], (50, 1))
    vectors, labels = fit_tree_palette(same, np.zeros(50), 20, 1.0)
    assert len(vectors) == 1
    assert not labels.any()


def test_existing_palette_is_recovered(rng):
    few = one_sided_model(rng, 300).parameters["sh_rest"]
    rest = few[rng.integers(0, 300, 2000)]
    vectors, labels = fit_tree_palette(rest, rng.normal(size=2000), 400, 1.0)
    assert len(vectors) <= 300
    assert np.abs(vectors[labels] - rest).mean() < 4 / SH_LEVELS


def test_small_harmonics_have_smaller_steps(rng):
    rest = rng.normal(0, 0.1, (500, 45))
    assert scaled_step(rest, 4.0, 6.0) == 6
    assert scaled_step(np.zeros((0, 45)), 4.0, 6.0) < 1
    np.testing.assert_allclose(scaled_step(rest / 10, 4.0, 6.0), 4 * 0.01 / sog_quantize.TYPICAL_RMS, rtol=0.05)


def test_sog_keeps_the_shape_and_converts_again_losslessly(tmp_path, rng):
    source = one_sided_model(rng, 1500)
    copy = round_trip(tmp_path / "a.sog", source)
    order = morton_order(source.parameters["means"])
    expected, shapes = covariances(source.rows(order)), covariances(copy)
    size = np.linalg.norm(expected, axis=(1, 2))
    assert (np.linalg.norm(shapes - expected, axis=(1, 2)) < 0.2 * size).all()
    rest = source.parameters["sh_rest"][order]
    base = compensate_base(source.parameters["sh_base"][order], rest - copy.parameters["sh_rest"], visible_form(rest))
    assert np.abs(copy.parameters["sh_base"] - base).max() < 0.03
    for name, bound in (("means", 0.01), ("logit_opacity", 1.0)):
        away = np.abs(copy.parameters[name] - source.parameters[name][order])
        assert np.percentile(away, 90) <= bound, name
    again = round_trip(tmp_path / "b.sog", copy)
    rows = np.lexsort(copy.parameters["means"].T), np.lexsort(again.parameters["means"].T)
    for name in ("sh_rest", "log_scales", "quats", "sh_base"):
        np.testing.assert_allclose(
            again.parameters[name][rows[1]], copy.parameters[name][rows[0]], atol=1e-4, err_msg=name
        )
