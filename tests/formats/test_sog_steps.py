"""Tables with fewer distinct values, on the levels of SOG, in fewer bytes."""

from pathlib import Path

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.formats.packing import morton_order
from clsplat.formats.palette import ENTRIES, fit_codebook
from clsplat.formats.sog_quantize import LEVELS, round_means, round_quats, round_to
from clsplat.formats.splats import WriteOptions, normalize_quats
from clsplat.formats.table import write
from tests.support.models import round_trip, splats


def covariances(quats, log_scales):
    turns = np.stack([ref.rotation_matrix(quat) for quat in normalize_quats(quats)])
    return np.einsum("nij,nj,nkj->nik", turns, np.exp(2.0 * log_scales), turns)


def test_permuted_axes_give_an_equal_gaussian_with_less_rotation(rng):
    quats, sizes = rng.normal(size=(2000, 4)), rng.normal(size=(2000, 3))
    actual, renamed = round_quats(quats, sizes, 1)
    assert (np.argmax(np.abs(actual), axis=1) == 0).all()
    assert actual[:, 0].min() > 0.84, "the farthest rotation from all that bring axes onto axes has 62.8 degrees"
    np.testing.assert_array_equal(np.sort(renamed, axis=1), np.sort(sizes.astype(np.float32), axis=1))
    expected = covariances(quats, sizes)
    largest = np.abs(expected).max(axis=(1, 2))
    assert (np.abs(covariances(actual, renamed) - expected).max(axis=(1, 2)) < 0.02 * largest).all()


def test_light_gaussians_have_larger_position_steps(rng):
    means, sizes = rng.normal(size=(3000, 3)).astype(np.float32), rng.normal(-3, 0.5, (3000, 3)).astype(np.float32)
    weights = rng.uniform(-4, 4, 3000)
    result = round_means(means, sizes, weights, 0.25)
    largest = 0.25 * np.exp(sizes.mean(axis=1)) * np.exp2(-weights / 2) / 2  # half a step
    level = np.log1p(np.abs(means)).max() * 2 / LEVELS * 5
    moved = np.abs(result - means).max(axis=1)
    assert (moved < np.maximum(largest, level) * 1.05).all()
    assert moved[weights < -2].mean() > 3 * moved[weights > 2].mean()


def test_positions_without_extent_do_not_change(rng):
    means = np.full((5, 3), 2.5, np.float32)
    np.testing.assert_allclose(round_means(means, np.zeros((5, 3)), np.zeros(5), 0.25), means, rtol=1e-6)


def test_codebook_has_equal_steps_where_they_suffice(rng):
    values = rng.normal(size=5000)
    entries = fit_codebook(values, 0.1)
    np.testing.assert_allclose(np.rint(entries / 0.1) * 0.1, entries)
    np.testing.assert_array_equal(fit_codebook(entries, 0.07), entries)
    fine = fit_codebook(values, 1e-4)
    np.testing.assert_array_equal(fine, fit_codebook(values))
    assert len(fine) == ENTRIES


def test_rounded_tables_are_written_exactly_in_fewer_bytes(tmp_path: Path, rng):
    source = splats(rng, 1500, 0)
    p = source.parameters
    p["log_scales"] -= 2
    round_trip(tmp_path / "before.sog", source, WriteOptions(quality="high"))
    p["means"] = round_means(p["means"], p["log_scales"], np.zeros(1500), 0.5)
    p["quats"], p["log_scales"] = round_quats(p["quats"], p["log_scales"], 4)
    p["log_scales"], p["sh_base"] = round_to(p["log_scales"], 0.1), round_to(p["sh_base"], 0.06)
    copy = round_trip(tmp_path / "after.sog", source, WriteOptions(quality="high"))
    expected = source.rows(morton_order(p["means"]))
    for name in ("means", "quats", "log_scales", "sh_base"):
        np.testing.assert_allclose(copy.parameters[name], expected.parameters[name], rtol=1e-4, atol=1e-5)
    assert (tmp_path / "after.sog").stat().st_size < 0.85 * (tmp_path / "before.sog").stat().st_size


def test_quality_matters_without_harmonics(tmp_path: Path, rng):
    for degree in (0, 1):
        source = splats(rng, 600, degree)
        source.parameters["sh_rest"][:] = 0
        sizes = []
        for quality in ("balanced", "high"):
            write(tmp_path / "a.sog", source, WriteOptions(quality=quality))
            sizes.append((tmp_path / "a.sog").stat().st_size)
        assert sizes[0] < 0.9 * sizes[1]
