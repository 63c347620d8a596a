"""The reference for grids, against finite differences, hand-made tables, and integrals; and grid shapes."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from clsplat.conformance.reference import nerf
from clsplat.conformance.reference.nerf import HashLevel
from clsplat.nerf.shape import FEATURES, FieldShape, GridShape

STEP = 1e-6


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("level", [HashLevel(3, 64), HashLevel(7, 16)], ids=["dense", "shared"])
def test_grid_and_network_gradient_matches_differences(rng, level):
    """Through a network that reads the position twice, for samples inside and outside of the cube."""
    samples, network = 12, nerf.DenseNetwork(2, 0)
    at, variances = rng.uniform(-0.2, 1.2, (samples, 3)), rng.uniform(1e-3, 1e-1, samples)
    table, sines, direction = (
        rng.normal(size=(level.entries, 2)),
        rng.normal(size=(samples, 3)),
        rng.normal(size=(samples, 2)),
    )
    shapes = [(5, 4), (4 + 5, 4), (4, 1), (4, 4), (4 + 2, 4), (4, 3)]
    weights = [(rng.normal(0, 0.7, shape), rng.normal(0, 0.5, shape[1])) for shape in shapes]
    grad_colors, grad_densities = rng.normal(size=(samples, 3)), rng.normal(size=(samples, 1))

    def outputs() -> tuple[np.ndarray, np.ndarray, nerf.Inputs]:
        position = np.concatenate([level.forward(table, at, variances), sines], axis=1)
        return network.forward(weights, position, direction)

    def value() -> float:
        colors, densities, _ = outputs()
        return float((colors * grad_colors).sum() + (densities * grad_densities).sum())

    _, grad_position = network.backward(weights, outputs()[2], grad_colors, grad_densities)
    result = level.backward(grad_position[:, :2], at, variances)
    numeric = np.zeros_like(table)
    for place in np.ndindex(table.shape):
        before = table[place]
        table[place] = before + STEP
        high = value()
        table[place] = before - STEP
        numeric[place] = (high - value()) / (2 * STEP)
        table[place] = before
    assert np.abs(numeric).max() > 0.1
    np.testing.assert_allclose(result, numeric, atol=1e-7)


def test_interpolation_reproduces_a_linear_function(rng):
    """Entries that are the coordinates give the position, also at the faces of the cube."""
    level = HashLevel(5, 6**3)
    corners = np.stack(np.meshgrid(*3 * [np.arange(6)], indexing="ij"), axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    at = np.concatenate([rng.random((20, 3)), [[0, 0, 0], [1, 1, 1], [1, 0, 0.5]]])
    np.testing.assert_allclose(level.forward(corners / 5, at, np.full(23, 1e-9)), at, atol=1e-12)


def test_points_outside_the_cube_have_no_features(rng):
    outside = np.array([[-1e-9, 0.5, 0.5], [0.5, 1 + 1e-9, 0.5], [0.5, 0.5, 7.0]])
    np.testing.assert_array_equal(HashLevel(4, 16).forward(rng.normal(size=(16, 4)), outside, np.ones(3)), 0.0)


def test_level_weight_is_close_to_the_papers():
    """erf(1 / sqrt(8 v n^2)), and so half of a cell's width under a normal distribution of the sample's size."""
    variances = 10.0 ** np.linspace(-8, 2, 60)
    expected = [math.erf(1 / math.sqrt(8 * v * 16**2)) for v in variances]
    np.testing.assert_allclose(HashLevel(16, 16).weights(variances), expected, atol=0.0071)


def test_levels_are_dense_while_corners_fit_and_are_contiguous():
    grid = GridShape(levels=4, coarsest=4, finest=32, entries=1024)
    assert grid.table.tolist() == [[4, 0, 125, 0], [8, 125, 729, 0], [16, 854, 1024, 1], [32, 1878, 1024, 1]]
    assert grid.parameter_count == FEATURES * (125 + 729 + 1024 + 1024)
    assert GridShape(levels=1, coarsest=3, finest=3).table.tolist() == [[3, 0, 64, 0]]


def test_grid_parameters_follow_the_networks_and_start_near_zero():
    plain, gridded = (FieldShape(degrees=2, grid=item) for item in (None, GridShape(levels=2, entries=16)))
    assert gridded.position_rows == plain.position_rows + 2 * FEATURES
    first = gridded.initial_parameters(3)
    own = first[gridded.network_length : gridded.network_length + gridded.grid.parameter_count]
    assert 0 < np.abs(own).min() < np.abs(own).max() < 1e-4
    assert FieldShape.model_validate(gridded.model_dump()) == gridded


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"entries": 100}, "power of 2"),
        ({"coarsest": 16, "finest": 8}, "must be at least .coarsest., 16; got 8"),
        ({"corner": [0.0, 1.0]}, "at least 3 items"),
    ],
)
def test_invalid_grid_is_refused(keys, complaint):
    with pytest.raises(ValidationError, match=complaint):
        GridShape(**keys)


def test_network_without_any_position_is_refused():
    with pytest.raises(ValidationError, match="needs a position"):
        FieldShape(degrees=0)
