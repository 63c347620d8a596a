"""Visible errors of harmonics, against sums over directions, and a palette that minimizes them."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.stages.palette import MIN_WEIGHT, UNSEEN_WEIGHT, VisibleError

POSITIONS = np.array([[3.0, 0, 1], [2, 2, 2], [0, 3, 1.5], [-1, 2.5, 0.5], [2.5, -1, 0.2]])


@pytest.fixture
def visibility(rng) -> SimpleNamespace:
    """Gaussians, and what they weigh in some views; the last one in none."""
    means, weights = rng.normal(0, 0.3, (60, 3)), rng.random((len(POSITIONS), 60)).astype(np.float32)
    weights[:, -1] = 0
    return SimpleNamespace(means=means, weights=weights)


def error_of(visibility: SimpleNamespace, coefficients: int) -> VisibleError:
    views = [SimpleNamespace(sum=lambda number, row=row: row) for row in visibility.weights]
    return VisibleError.from_views(zip(views, POSITIONS, strict=True), visibility.means, coefficients)


def visible_error(visibility: SimpleNamespace, i: int, error: np.ndarray) -> float:
    """The squared error of a Gaussian's colors over the views, after the best change of its base color."""
    directions = visibility.means[i] - POSITIONS
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = ref.sh_basis(directions, 3)[:, 1 : 1 + len(error) // 3] @ error.reshape(-1, 3)
    weight = visibility.weights[:, i].astype(np.float64)[:, None]
    best = (weight * colors).sum(axis=0) / weight.sum()
    return float((weight * np.square(colors - best)).sum())


@pytest.mark.parametrize("coefficients", [3, 8, 15])
def test_quadratic_form_is_the_error_visible_in_the_views(visibility, rng, coefficients):
    result, errors = error_of(visibility, coefficients), rng.normal(size=(60, 3 * coefficients))
    forms = (result.gradient(errors) * errors).sum(axis=1)
    everywhere = UNSEEN_WEIGHT / (4 * np.pi) * (result.weights + MIN_WEIGHT * result.weights.mean())
    expected = [visible_error(visibility, i, errors[i]) for i in range(59)]
    np.testing.assert_allclose(
        (forms - everywhere * np.square(errors).sum(axis=1))[:59], expected, rtol=1e-6, atol=1e-9
    )
    assert forms[59] > 0, "a Gaussian that no view shows has a form"


def test_base_color_absorbs_the_mean_error(visibility, rng):
    result, error = error_of(visibility, 15), rng.normal(size=(60, 45))
    change = result.base_change(error)
    directions = visibility.means[7] - POSITIONS
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = ref.sh_basis(directions, 3)[:, 1:] @ error[7].reshape(15, 3)
    mean = np.average(colors, axis=0, weights=visibility.weights[:, 7])
    np.testing.assert_allclose(change[7] * 0.28209479177387814, mean, rtol=1e-6)


def test_palette_refinement_lowers_the_visible_error(visibility, rng):
    result, rest = error_of(visibility, 15), rng.normal(0, 0.1, (60, 45)).astype(np.float32)

    def error_with(vectors: np.ndarray) -> float:
        left = (rest[:, None] - vectors)[np.arange(60)[:, None], np.arange(len(vectors))]
        forms = [(result.gradient(left[:, e]) * left[:, e]).sum(axis=1) for e in range(len(vectors))]
        return float(np.min(forms, axis=0).sum())

    def most_alike(points: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        return (points.astype(np.float64) @ vectors.T.astype(np.float64)).argmax(axis=1)

    first = rest[:8].astype(np.float64)
    vectors, labels = result.improve_palette(rest, first, nearest=most_alike)
    assert error_with(vectors) < 0.8 * error_with(first)
    left = rest - vectors[labels]
    assert (result.gradient(left) * left).sum() == pytest.approx(error_with(vectors), rel=1e-4), "each has its best one"
