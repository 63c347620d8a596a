"""A packed model matches the model within its quantization steps; equal models give equal bytes."""

import gzip
from dataclasses import replace

import numpy as np
import pytest

from clsplat.viewer.packing import BLOCK, KNEE, LEVELS, MAX_LOG_RATIO, MIN_RANGE, STEPS, pack
from tests.support.viewer_data import unpacked
from tests.support.viewer_pages import MIP, cloud

RNG = np.random.default_rng(5)


def spread(count: int, **changes):
    """A model whose splats can be told apart by their opacities, which no view leaves out."""
    model = cloud(count, **changes)
    opacity = np.linspace(0.05, 0.95, count)[RNG.permutation(count)]
    return replace(model, logit_opacity=np.log(opacity / (1 - opacity))[:, None])


def logarithmic(means, header):
    offsets = (means.astype(np.float64) - header["origin"]) / header["unit"]
    return np.sign(offsets) * np.log1p(np.abs(offsets))


def matched(model, actual):
    """Rows of the model in the order of what was found, by the nearest mean."""
    distances = np.linalg.norm(actual.means[:, None] - model.means[None].astype(np.float64), axis=2)
    rows = distances.argmin(axis=1)
    assert sorted(rows) == list(range(len(model)))
    return model[rows]


@pytest.mark.parametrize(
    ("count", "degree"), [(1, 0), (2, 1), (BLOCK - 1, 2), (BLOCK, 3), (BLOCK + 1, 0), (3 * BLOCK + 7, 3)]
)
def test_packing_round_trips_within_its_steps(count, degree):
    model = spread(count, degree=degree)
    packed = pack(model)
    pixels = unpacked(packed)
    model = matched(model, pixels)
    before, after = (logarithmic(means, packed.header) for means in (model.means, pixels.means))
    for part in (slice(begin, begin + BLOCK) for begin in range(0, count, BLOCK)):
        assert (np.abs(after[part] - before[part]) <= 0.51 * np.ptp(before[part], axis=0) / STEPS + 1e-6).all()
    unit = model.quats / np.linalg.norm(model.quats, axis=1, keepdims=True)
    assert (np.abs((pixels.quats * unit).sum(axis=1)) > 1 - 2e-6).all(), "0.2 degrees"
    logs = np.maximum(model.log_scales, model.log_scales.max(axis=1, keepdims=True) - MAX_LOG_RATIO)
    assert np.abs(np.log(pixels.scales) - logs).max() < 0.03
    assert np.abs(pixels.opacities - model.opacities).max() < 0.003
    assert np.abs(pixels.sh[:, 0] - model.sh_base).max() < 0.03
    half_steps = np.hypot(KNEE, model.sh_rest) * np.arcsinh(MIN_RANGE / KNEE) / 254  # the slope of the table's sinh
    assert (np.abs(pixels.sh[:, 1:].reshape(count, -1) - model.sh_rest) <= 1.02 * half_steps).all()


def test_same_model_gives_the_same_bytes():
    packed = pack(cloud(500))
    assert packed == pack(cloud(500))
    assert packed.data[4:8] == bytes(4), "the time in the header of gzip"
    assert packed.data != pack(cloud(500, seed=1)).data


def test_file_order_does_not_matter():
    model = spread(700)
    assert pack(model).data == pack(model[RNG.permutation(700)]).data


def test_first_parts_are_the_most_important():
    model = spread(800)
    packed = pack(model)
    pixels = unpacked(packed)
    assert packed.header["levels"] == [100 * (i + 1) for i in range(LEVELS)]
    weight = pixels.opacities * np.sort(pixels.scales, axis=1)[:, 1:].prod(axis=1)
    parts = weight.reshape(LEVELS, 100)
    assert (parts[:-1].min(axis=1) >= 0.9 * parts[1:].max(axis=1)).all()


def test_limit_keeps_the_most_important():
    model = spread(800)
    weight = model.opacities * np.sort(model.scales, axis=1)[:, 1:].prod(axis=1)
    kept = unpacked(pack(model, 200))
    best = model[np.argsort(-weight)[:200]]
    assert len(kept.means) == 200
    np.testing.assert_allclose(np.sort(kept.means[:, 0]), np.sort(best.means[:, 0]), atol=0.01)


def test_invisible_splats_are_omitted():
    model = spread(10)
    tables = {name: table.copy() for name, table in model.tables().items()}
    tables["means"][0, 1] = np.nan
    tables["sh_base"][1, 2] = np.inf
    tables["quats"][2] = 0
    tables["logit_opacity"][3] = -5.6  # an opacity below 1/255
    tables["log_scales"][4] = -np.inf
    packed = pack(replace(model, **tables))
    assert packed.count == 5
    assert packed.header["faint"] == 1, "the page says so"
    assert pack(replace(model, **tables), 2).header["faint"] == 0, "others are left out too"
    np.testing.assert_allclose(np.sort(unpacked(packed).means[:, 0]), np.sort(model.means[5:, 0]), atol=1e-3)


def test_empty_model_can_be_packed():
    packed = pack(cloud(4)[:0])
    assert (packed.count, packed.header["levels"]) == (0, [0] * LEVELS)
    assert len(unpacked(packed).means) == 0


def test_coincident_splats_of_equal_size():
    model = cloud(300)
    same = {name: np.repeat(table[:1], 300, axis=0) for name, table in model.tables().items()}
    pixels = unpacked(pack(replace(model, **same)))
    np.testing.assert_allclose(pixels.means, same["means"], rtol=1e-6)
    np.testing.assert_allclose(np.log(pixels.scales), same["log_scales"], rtol=1e-5)


def test_extreme_colors_survive_packing():
    model = spread(300)
    wild = replace(model, sh_rest=model.sh_rest * 60, sh_base=model.sh_base * 20)
    pixels = unpacked(pack(wild))
    wild = matched(wild, pixels)
    most = np.abs(wild.sh_rest).max()
    error = np.abs(pixels.sh[:, 1:].reshape(300, -1) - wild.sh_rest)
    assert (error < 0.02 * np.abs(wild.sh_rest) + 0.01).all(), most
    assert np.abs(pixels.sh[:, 0] - wild.sh_base).max() < 0.02 * np.abs(wild.sh_base).max()


def test_render_settings_and_world_filter():
    model = replace(spread(50), rendering=MIP, filter_variance=np.full((50, 1), 0.01, np.float32))
    packed = pack(model)
    header = packed.header
    assert (header["near"], header["variance"], header["compensate"]) == (0.2, 0.1, 1.0)
    assert unpacked(packed).scales.min() > 0.098, "the filter is part of the scales"
    assert packed == pack(model.baked())


def test_zero_colors_stay_zero():
    model = replace(spread(64), sh_rest=np.zeros((64, 45), np.float32))
    assert (unpacked(pack(model)).sh[:, 1:] == 0).all()
    assert len(gzip.decompress(pack(model).data)) == 4 * 1024 + 24 + 64 * (6 + 4 + 4 + 48)
