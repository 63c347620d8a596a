"""Similarity transforms: known answers under noise and outliers, in map coordinates; UTM; the ground plane."""

import math

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from clsplat.core.errors import DataError
from clsplat.scene.control import FLATTENING, SEMI_MAJOR_AXIS, to_utm
from clsplat.scene.similarity import UP, Correspondences, Similarity, level, rotation_between
from clsplat.scene.viewpoint import ground_plane

UTM = np.array([500_000.0, 4_500_000.0, 30.0])


def known_transform(rng: np.random.Generator) -> Similarity:
    rotation = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    return Similarity(float(np.exp(rng.normal())), rotation, UTM + rng.normal(size=3))


@pytest.mark.parametrize("count", [3, 8, 400])
def test_exact_points_give_the_transform(rng, count):
    known, source = known_transform(rng), rng.normal(size=(count, 3))
    actual, is_outlier = Correspondences(source, known.apply(source)).fit_inliers()
    np.testing.assert_allclose(actual.rotation, known.rotation, atol=1e-8)
    assert actual.scale == pytest.approx(known.scale, rel=1e-8)
    np.testing.assert_allclose(actual.apply(source), known.apply(source), atol=1e-8)
    assert not is_outlier.any()


@pytest.mark.parametrize("trial", range(6))
def test_outliers_are_found_under_noise(trial):
    rng = np.random.default_rng(trial)
    known, source = known_transform(rng), rng.uniform(-5, 5, (14, 3))
    noise, wrong = 0.02 * known.scale, rng.choice(14, 4, replace=False)
    target = known.apply(source) + rng.normal(0, noise, (14, 3))
    target[wrong] += 20 * noise * (1 + rng.exponential(10, (4, 1))) * rng.choice([-1, 1], (4, 3))
    actual, is_outlier = Correspondences(source, target).fit_inliers()
    assert sorted(np.flatnonzero(is_outlier)) == sorted(wrong)
    kept = np.delete(np.arange(14), wrong)
    reference = Rotation.align_vectors(target[kept] - target[kept].mean(0), source[kept] - source[kept].mean(0))[0]
    np.testing.assert_allclose(actual.rotation, reference.as_matrix(), atol=1e-9)
    assert np.abs(actual.apply(source) - known.apply(source)).max() < 4 * noise


def test_known_up_and_scale_are_kept(rng):
    known, source = known_transform(rng), rng.normal(size=(9, 3)) * [5, 0.001, 0.001]  # on a line
    up = known.rotation.T @ [0, 0, 1]
    target = known.apply(source) + rng.normal(0, 0.01, (9, 3))
    for shrink in (1, 1e-4):  # of the known coordinates, such as millimeters to meters
        with pytest.raises(DataError, match="nearly on a line"):
            Correspondences(source, shrink * target).fit_inliers()
    actual, _ = Correspondences(source, target, known.scale, up).fit_inliers()
    np.testing.assert_allclose(actual.rotation @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(actual.rotation, known.rotation, atol=0.01)
    assert actual.scale == known.scale


def test_contradictory_points_are_reported(rng):
    """The message blames the coordinates, and a distance if there is one, not the positions of the points."""
    known, source = known_transform(rng), rng.normal(size=(6, 3))
    target = known.apply(source)
    Correspondences(source, 1e-4 * target).fit_inliers()
    with pytest.raises(DataError, match=r"points do not fit .*check the coordinates and --distance"):
        Correspondences(source, target, 0.01 * known.scale).fit_inliers()
    with pytest.raises(DataError, match=r"points do not fit .*check the coordinates$"):
        Correspondences(source[:4], rng.permutation(target)[:4] * [1, -1, 1]).fit_inliers()


@pytest.mark.parametrize("end", [UP, -UP, np.array([0.6, 0.0, 0.8])])
def test_rotation_between_directions(end):
    rotation = rotation_between(UP, end)
    np.testing.assert_allclose(rotation @ UP, end, atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_utm_coordinates_of_known_places_are_right():
    """The CN Tower, as published; a quarter of the meridian by numerical integration; a southern place."""
    tower, epsg = to_utm(np.array([[43.642567, -79.387139, 100.0]]))
    np.testing.assert_allclose(tower, [[630084, 4833438, 100]], atol=1)
    assert epsg == 32617
    e2 = FLATTENING * (2 - FLATTENING)
    arc = scipy.integrate.quad(
        lambda p: SEMI_MAJOR_AXIS * (1 - e2) / (1 - e2 * math.sin(p) ** 2) ** 1.5, 0, math.radians(70)
    )[0]
    position, epsg = to_utm(np.array([[70.0, 9.0, 0.0]]))
    np.testing.assert_allclose(position, [[500_000, 0.9996 * arc, 0]], atol=1e-3)
    assert epsg == 32632
    position, epsg = to_utm(np.array([[-33.8568, 151.2153, 5.0]]))  # the Sydney Opera House
    assert epsg == 32756
    assert 334_800 < position[0, 0] < 335_000
    assert 6_252_200 < position[0, 1] < 6_252_400


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_ground_is_found_below_objects(rng, tilt):
    """A floor with noise, a larger wall, objects, and points below the floor; y points down."""
    floor = np.column_stack([rng.uniform(-3, 3, 800), rng.normal(1.5, 0.01, 800), rng.uniform(-3, 3, 800)])
    wall = np.column_stack([np.full(1500, 3.0), rng.uniform(-1.5, 1.5, 1500), rng.uniform(-3, 3, 1500)])
    objects, below = rng.normal(0, 0.4, (1500, 3)), rng.normal((0, 4, 0), 1, (40, 3))
    turn = Rotation.from_euler("z", tilt, degrees=True).as_matrix()
    points = np.concatenate([floor, wall, objects, below]) @ turn.T
    up, height = ground_plane(points, UP)
    assert np.degrees(np.arccos(up @ turn @ UP)) < 0.2
    assert height == pytest.approx(-1.5, abs=0.01)
    leveled = level(up, points.mean(axis=0), height).apply(points)
    assert np.abs(leveled[:800, 1]).max() < 0.1


def test_points_without_ground_are_refused(rng):
    with pytest.raises(DataError, match="of the points are on a level plane"):
        ground_plane(rng.normal(size=(3000, 3)), UP)
