"""Decimation by merging pairs, against a simple float64 reference, and preserved properties."""

from dataclasses import replace

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians import mixture
from clsplat.gaussians.conversion import merged, with_sky_splats
from clsplat.gaussians.mixture import covariance_matrices, masses, match_pairs, merge, pair_cost, surface, volume
from clsplat.gaussians.model import Model, Rendering
from clsplat.gaussians.sky import Sky
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.workflows.lod import decimate
from tests.support.models import interop, splats


def model(rng: np.random.Generator, count: int, degree: int = 2, mode: str = "default") -> Model:
    """Faint Gaussians of like sizes."""
    tables = splats(rng, count, degree, mode).parameters
    tables["log_scales"] = rng.uniform(-2, -1, (count, 3)).astype(np.float32)
    tables["logit_opacity"] = rng.uniform(-4, -2, (count, 1)).astype(np.float32)
    return Model(**tables, rendering=Rendering(screen_variance=0.1, compensate=float(mode == "mip")))


def float64_tables(source: Model) -> dict[str, np.ndarray]:
    return {name: table.astype(np.float64) for name, table in source.tables().items()}


def area(scales: np.ndarray) -> float:
    """Thomsen's surface of an ellipsoid, over 4 pi."""
    a, b, c = scales
    p = 1.6075
    return float((((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p))


def moments(tables: dict[str, np.ndarray], row: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, mean and covariance of one Gaussian, written out."""
    w, x, y, z = tables["quats"][row] / np.linalg.norm(tables["quats"][row])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    scales = np.exp(tables["log_scales"][row])
    mass = area(scales) / (1 + np.exp(-tables["logit_opacity"][row, 0]))
    return mass, tables["means"][row], turn @ np.diag(scales**2) @ turn.T


def test_merged_pair_has_the_moments_of_its_mixture(rng):
    tables = float64_tables(model(rng, 40))
    first, second = np.arange(0, 40, 2), np.arange(1, 40, 2)
    result = merge(tables, first, second, surface)
    for pair, (i, j) in enumerate(zip(first, second, strict=True)):
        (a, mean_a, cov_a), (b, mean_b, cov_b) = moments(tables, i), moments(tables, j)
        mean = (a * mean_a + b * mean_b) / (a + b)
        apart_a, apart_b = mean_a - mean, mean_b - mean
        covariance = (a * (cov_a + np.outer(apart_a, apart_a)) + b * (cov_b + np.outer(apart_b, apart_b))) / (a + b)
        mass, mean_found, covariance_found = moments(result, pair)
        np.testing.assert_allclose(mean_found, mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covariance_found, covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(mass, a + b, rtol=1e-9)
        for name in ("sh_base", "sh_rest"):
            color = (a * tables[name][i] + b * tables[name][j]) / (a + b)
            np.testing.assert_allclose(result[name][pair], color, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [surface, volume])
def test_mixture_is_symmetric_in_its_pair(rng, size):
    tables = float64_tables(model(rng, 20))
    first, two = np.arange(10), np.arange(10, 20)
    there, back = merge(tables, first, two, size), merge(tables, two, first, size)
    for found in (there, back):
        found["covariance"] = covariance_matrices(found.pop("quats"), found["log_scales"])
    for name in there:
        np.testing.assert_allclose(there[name], back[name], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(pair_cost(tables, first, two), pair_cost(tables, two, first), rtol=1e-9)


@pytest.mark.parametrize("count", [2, 3, 64, 257])
def test_mass_and_mean_are_preserved(rng, count):
    source = model(rng, count)
    result = decimate(source)
    assert len(result) == (count + 1) // 2
    before, after = float64_tables(source), float64_tables(result)
    mass = [masses(tables, surface) for tables in (before, after)]
    np.testing.assert_allclose(mass[1].sum(), mass[0].sum(), rtol=1e-5)
    mean = [(one[:, None] * tables["means"]).sum(axis=0) for one, tables in zip(mass, (before, after), strict=True)]
    np.testing.assert_allclose(mean[1], mean[0], rtol=1e-4, atol=1e-4 * mass[0].sum())
    for name in PARAMETERS:
        assert getattr(result, name).dtype == np.float32


def test_target_fraction_is_reached_in_several_rounds(rng):
    assert [len(decimate(model(rng, 100), keep)) for keep in (1, 0.7, 0.25, 0.001)] == [100, 70, 25, 1]


def test_zero_and_one_gaussian_do_not_change(rng):
    for count in (0, 1):
        source = model(rng, count)
        result = decimate(source)
        for name, table in source.tables().items():
            np.testing.assert_array_equal(getattr(result, name), table)


def test_same_model_gives_same_bytes_in_any_row_order(rng):
    source = model(rng, 300)
    result, again = decimate(source), decimate(source[:])
    for name, table in result.tables().items():
        assert table.tobytes() == getattr(again, name).tobytes()
    mixed = decimate(source[rng.permutation(300)])
    for name in ("means", "sh_base"):
        tables = (np.sort(getattr(item, name), axis=0) for item in (result, mixed))
        np.testing.assert_allclose(*tables, rtol=1e-4, atol=1e-5)


def test_coincident_duplicates_merge(rng):
    """More of them than the number of neighbors."""
    first = model(rng, 1)
    result = decimate(first[np.zeros(51, int)])
    assert len(result) == 26
    np.testing.assert_allclose(result.means, np.repeat(first.means, 26, axis=0), rtol=1e-6)
    np.testing.assert_allclose(np.sort(result.log_scales), np.repeat(np.sort(first.log_scales), 26, axis=0), rtol=1e-5)
    alone = np.isclose(result.logit_opacity, first.logit_opacity, rtol=1e-5)
    assert alone.sum() == 1, "25 pairs, and the odd one"


def test_coincident_gaussians_need_no_extra_work(rng):
    """A round pairs them all: a tree of places alone, or of rows, takes quadratic time here."""
    first = model(rng, 1, degree=0)
    rows = [len(pairs) for pairs in match_pairs(float64_tables(first[np.zeros(30_000, int)]))]
    assert rows == [15_000, 15_000]


def test_work_grows_with_rows_and_pairs_not_with_their_product(rng, monkeypatch):
    """Masses are those of all rows once, and not again for each block of pairs."""
    rows: list[int] = []
    monkeypatch.setattr(
        mixture, "masses", lambda tables, size: rows.append(len(tables["means"])) or masses(tables, size)
    )
    source = float64_tables(model(rng, 300))
    whole = match_pairs(source)
    monkeypatch.setattr(mixture, "BLOCK", 50)
    for one, two in zip(match_pairs(source), whole, strict=True):
        np.testing.assert_array_equal(one, two)
    assert rows == [300, 300]


def test_cheapest_pair_merges_first_and_pairs_are_disjoint():
    """Three in a row, and two equal ones far away."""
    x = np.array([0, 0.1, 0.35, 9, 9], np.float32)
    tables = {
        "means": np.stack([x, 0 * x, 0 * x], axis=1),
        "quats": np.tile([1.0, 0, 0, 0], (5, 1)),
        "log_scales": np.full((5, 3), -1.0),
        "logit_opacity": np.full((5, 1), -3.0),
        "sh_base": np.zeros((5, 3)),
        "sh_rest": np.zeros((5, 0)),
    }
    first, second = match_pairs({name: table.astype(np.float64) for name, table in tables.items()})
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(3, 4), (0, 1)]


def test_neighbors_of_different_color_do_not_merge():
    tables = {
        "means": np.array([[0.0, 0, 0], [0.1, 0, 0], [0.25, 0, 0]]),
        "quats": np.tile([1.0, 0, 0, 0], (3, 1)),
        "log_scales": np.full((3, 3), -1.0),
        "logit_opacity": np.full((3, 1), -3.0),
        "sh_base": np.array([[1.0] * 3, [-1.0] * 3, [-1.0] * 3]),
        "sh_rest": np.zeros((3, 0)),
    }
    assert [rows.tolist() for rows in match_pairs(tables)] == [[1], [2]]


def test_extreme_values_and_zero_quaternions_merge_finitely(rng):
    source = model(rng, 24)
    source.log_scales[:6] = (-80, -80, 3)
    source.log_scales[6:9] = 60
    source.quats[3:9] = 0
    source.logit_opacity[8:16] = (np.arange(8)[:, None] - 4) * 30
    source.means[20] = 1e30
    result = decimate(source, 0.25)
    assert len(result) == 6
    assert all(np.isfinite(table).all() for table in result.tables().values())


def test_mip_model_keeps_its_settings_and_bakes_a_world_filter(rng):
    source = model(rng, 10, mode="mip")
    filtered = Model(**source.tables(), filter_variance=np.full((10, 1), 0.1), rendering=source.rendering)
    result = decimate(filtered)
    assert result.filter_variance is None
    assert result.rendering == source.rendering
    np.testing.assert_array_equal(result.means, decimate(filtered.baked()).means)


def test_unmergeable_model_is_refused(rng):
    source = model(rng, 5)
    for keep in (0, -1, 1.5, float("nan")):
        with pytest.raises(ConfigError, match="expected a fraction"):
            decimate(source, keep)
    source.means[2, 1] = np.nan
    with pytest.raises(DataError, match="1 Gaussians have values that are not finite"):
        decimate(source)


def test_convert_merges_to_a_number_of_gaussians(rng, tmp_path):
    """The mass, mean, and covariance of the whole model stay, whatever the number; the same bytes twice."""
    source = model(rng, 300, degree=1)
    source.save(tmp_path / "a.ply")
    sums = []
    for name, count in (("b.ply", 1000), ("c.ply", 150), ("d.ply", 7), ("e.ply", 150)):
        assert clsplat.convert(tmp_path / "a.ply", tmp_path / name, splats=count)["gaussians"] == min(count, 300)
        tables = float64_tables(clsplat.load(tmp_path / name))
        parts = [moments(tables, row) for row in range(min(count, 300))]
        mass = sum(part[0] for part in parts)
        mean = sum(part[0] * part[1] for part in parts) / mass
        spread = sum(part[0] * (part[2] + np.outer(part[1] - mean, part[1] - mean)) for part in parts) / mass
        sums.append((mass, mean, spread))
        for actual, expected in zip(sums[-1], sums[0], strict=True):
            np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)
    assert (tmp_path / "c.ply").read_bytes() == (tmp_path / "e.ply").read_bytes()


def test_half_of_the_gaussians_look_almost_the_same():
    """31.9 dB from four sides; the larger half of the Gaussians reaches 29.5 dB."""
    source = clsplat.load(interop("playbot31k.ply"))
    center = np.median(source.means, axis=0).astype(np.float64)
    reach = 3 * np.quantile(np.linalg.norm(source.means - center, axis=1), 0.95)
    offsets = [(np.cos(angle), -0.3, np.sin(angle)) for angle in np.arange(4) * np.pi / 2]
    camera = Camera(160, 160, 200, 200, 80, 80)
    views = [View.looking_at(center + reach * np.array(offset), center, (0, -1, 0), camera) for offset in offsets]
    expected = [clsplat.Renderer(source).render(view).image for view in views]

    def psnr(reduced: Model) -> float:
        renderer = clsplat.Renderer(reduced)
        images = [np.clip(renderer.render(view).image, 0, 1) for view in views]
        return float(-10 * np.log10(np.mean(np.square(np.subtract(images, np.clip(expected, 0, 1))))))

    result = merged(source, len(source) // 2)
    size = source.opacities * np.sort(source.scales, axis=1)[:, 1:].prod(axis=1)
    assert len(result) == len(source) // 2
    assert psnr(result) > 31
    assert psnr(result) > psnr(source[np.argsort(-size)[: len(result)]]) + 2


def test_sky_is_not_merged_and_motion_is_rejected(rng):
    source = replace(model(rng, 300), sky=Sky(rng.random((64, 3)).astype(np.float32)))
    whole = with_sky_splats(source, count=50)
    result = merged(whole, 150)
    np.testing.assert_array_equal(result.means[150:], whole.means[300:])
    assert (len(result), len(result.scene_means)) == (200, 150)
    with pytest.raises(ConfigError, match="--splats 0: expected a number of Gaussians of at least 1"):
        merged(whole, 0)
    motion = np.zeros((300, 5), np.float32)
    with pytest.raises(ConfigError, match="--splats needs a static model; add --time T"):
        merged(replace(source, motion=motion), 20)
