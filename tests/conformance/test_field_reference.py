"""The reference for fields, against finite differences, integrals, and hand-computed values."""

import numpy as np
import pytest

from clsplat.conformance.reference import PinholeCamera, nerf

SAMPLES, STEP = 5, 1e-5


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def some_cones(rng: np.random.Generator, count: int = 3) -> np.ndarray:
    """Rays of a rotated and translated camera."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.column_stack([turn * np.linalg.det(turn), [0.3, -0.2, 4.0]])
    return nerf.cones(PinholeCamera(pose, 20.0, 24.0, 7.5, 5.0, 16, 12), rng.integers(0, 192, count))


def test_ray_meets_pixel_center_and_cone_has_its_width(rng):
    camera = PinholeCamera(np.eye(3, 4), 20.0, 24.0, 8.0, 6.0, 16, 12)
    (ray,) = nerf.cones(camera, np.array([3 * 16 + 5]))
    np.testing.assert_allclose(ray[3:6], [(5.5 - 8) / 20, (3.5 - 6) / 24, 1])
    neighbor = nerf.cones(camera, np.array([3 * 16 + 6]))[0]
    assert ray[6] == pytest.approx(np.linalg.norm(neighbor[3:6] - ray[3:6]) * 2 / np.sqrt(12))
    assert ray[7] == pytest.approx(np.linalg.norm(ray[3:6]))


def test_frustum_moments_match_those_of_its_points(rng):
    (ray,) = some_cones(rng, 1)
    ray[6] = 0.2  # a wide cone
    t0, t1 = 1.0, 2.5
    means, variances = nerf.frustums(ray[None], np.array([[t0, t1]]))
    t = (t0**3 + rng.random(400_000) * (t1**3 - t0**3)) ** (1 / 3)  # sections grow with the square of the distance
    along = ray[3:6] / ray[7]
    first = np.cross(along, [0.0, 0.6, 0.8])
    first /= np.linalg.norm(first)
    other = np.cross(along, first)
    angle, radius = rng.random(len(t)) * 2 * np.pi, ray[6] * t * np.sqrt(rng.random(len(t)))
    across = (radius * np.cos(angle))[:, None] * first + (radius * np.sin(angle))[:, None] * other
    points = ray[:3] + t[:, None] * ray[3:6] + across
    np.testing.assert_allclose(points.mean(axis=0), means[0, 0], atol=5e-3)
    np.testing.assert_allclose(points.var(axis=0), variances[0, 0], atol=5e-3)


def test_features_are_mean_sines_of_a_normal_distribution(rng):
    mean, variance = rng.normal(size=(1, 1, 3)), rng.random((1, 1, 3))
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    points = mean[0, 0, :, None] + np.sqrt(variance[0, 0])[:, None] * nodes
    expected = [
        (function(2.0**degree * points) * weights).sum(axis=1) / weights.sum()
        for function in (np.sin, np.cos)
        for degree in range(3)
    ]
    np.testing.assert_allclose(nerf.encode_frustums(mean, variance, 3)[0, 0], np.concatenate(expected), atol=1e-9)


def test_fine_edges_follow_the_weights():
    edges = np.linspace(2, 6, 9)
    weights = np.zeros(8)
    weights[5] = 1.0
    fine = nerf.fine_edges(edges, weights, 100)
    assert (np.diff(fine) >= 0).all()
    inside = (fine >= edges[4]) & (fine <= edges[7])  # the interval and its neighbors: weights are blurred
    assert inside.mean() > 0.95


def test_even_weights_leave_edges_even():
    edges = np.linspace(2, 6, 9)
    np.testing.assert_allclose(nerf.fine_edges(edges, np.full(8, 0.1), 16), np.linspace(2, 6, 17), atol=1e-6)


def test_sampled_coarse_edges_stay_sorted(rng):
    edges = nerf.coarse_edges(2, 6, 8, rng.random(9))
    assert (np.diff(edges) > 0).all()
    assert edges[0] >= 2
    assert edges[-1] <= 6


@pytest.mark.parametrize("skip", [None, 0, 1])
def test_field_gradient_matches_finite_differences(rng, skip):
    network, rays, width, position, direction = nerf.DenseNetwork(3, skip), 2, 4, 6, 5
    joined = [position if i - 1 == skip and skip is not None else 0 for i in range(3)]
    shapes = [(position, width), (width + joined[1], width), (width + joined[2], width)]
    shapes += [(width, 1), (width, width), (width + direction, width), (width, 3)]
    weights = [(rng.normal(0, 0.7, shape), rng.normal(0, 0.5, shape[1])) for shape in shapes]
    positions = rng.normal(size=(rays * SAMPLES, position))
    directions = rng.normal(size=(rays * SAMPLES, direction))
    lengths, background = rng.uniform(0.1, 0.5, (rays, SAMPLES)), np.array([1.0, 0.5, 0.2])
    wanted = rng.random((rays, 3))

    def composite() -> tuple[nerf.Composite, nerf.Inputs]:
        colors, densities, inputs = network.forward(weights, positions, directions)
        shaped = colors.reshape(rays, SAMPLES, 3), densities.reshape(rays, SAMPLES)
        return nerf.Composite(*shaped, lengths, background), inputs

    def loss() -> float:
        return float(((composite()[0].colors() - wanted) ** 2).sum())

    actual, inputs = composite()
    grad_raw, grad_densities = actual.backward(2 * (actual.colors() - wanted))
    gradient, _ = network.backward(weights, inputs, grad_raw.reshape(-1, 3), grad_densities.reshape(-1, 1))
    for own, expected in zip(weights, gradient, strict=True):
        for values, derivative in zip(own, expected, strict=True):
            numeric = np.zeros(values.shape)
            for at in np.ndindex(values.shape):
                before = values[at]
                values[at] = before + STEP
                high = loss()
                values[at] = before - STEP
                numeric[at] = (high - loss()) / (2 * STEP)
                values[at] = before
            np.testing.assert_allclose(derivative, numeric, atol=1e-7)


def test_ray_weights_and_transmittance_sum_to_one(rng):
    result = nerf.Composite(rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5)), np.full((2, 5), 0.3), np.ones(3))
    weights, left = result.weights()
    np.testing.assert_allclose(weights.sum(axis=1) + left[:, -1], 1)
    np.testing.assert_allclose(result.samples[1], np.log1p(np.exp(result.raw_densities - 1)))
