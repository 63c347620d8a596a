"""k-means: exact whole numbers, at the edges of groups and lanes, and the same file with and without a device."""

from functools import partial

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.formats.palette import LEVELS, HostClusters, palette
from clsplat.formats.sog_writing import Harmonics
from clsplat.gaussians.clusters import AT_ONCE, DeviceClusters, most_alike
from tests.support.models import splats


def whole(rng: np.random.Generator, rows: int, components: int, most: int = LEVELS) -> np.ndarray:
    return rng.integers(-most, most + 1, (rows, components)).astype(np.float32)


@pytest.mark.parametrize("components", [3, 9, 45])
@pytest.mark.parametrize(
    ("count", "entries"), [(0, 1), (1, 1), (15, 7), (16, 8), (17, 9), (64, 16), (65, 3), (129, 33)]
)
def test_labels_distances_and_sums_are_exact(device, rng, count, entries, components):
    points, vectors = whole(rng, count, components), whole(rng, entries, components)
    expected, half = ref.nearest_vectors(points, vectors)
    for clusters in (DeviceClusters(device, points), HostClusters(points)):
        labels, distance = clusters.nearest(vectors)
        np.testing.assert_array_equal(labels, expected)
        np.testing.assert_array_equal(distance, half.astype(np.float32))
        np.testing.assert_array_equal(clusters.sums(labels, entries), ref.member_sums(points, labels, entries))


def test_the_largest_numbers_are_exact_too(device):
    """45 products of 511 by 511 are below 2^24; twice the distance is not."""
    corners = np.where(np.random.default_rng(0).random((40, 45)) < 0.5, -LEVELS, LEVELS).astype(np.float32)
    points = np.concatenate([corners, -corners])
    device_labels, device_distance = DeviceClusters(device, points).nearest(corners)
    host_labels, host_distance = HostClusters(points).nearest(corners)
    np.testing.assert_array_equal(device_labels, host_labels)
    np.testing.assert_array_equal(device_distance, host_distance)
    np.testing.assert_array_equal(device_labels[:40], np.arange(40))


def test_of_equally_near_vectors_the_first_counts(device, rng):
    points, vectors = whole(rng, 70, 9, most=1), whole(rng, 40, 9, most=1)
    labels, _ = DeviceClusters(device, points).nearest(vectors)
    np.testing.assert_array_equal(labels, ref.nearest_vectors(points, vectors)[0])


def test_what_is_not_a_number_disturbs_no_other_point(device, rng):
    points, vectors = whole(rng, 40, 9), whole(rng, 11, 9)
    broken = points.copy()
    broken[[3, 17]] = np.nan
    clusters, others = DeviceClusters(device, broken), np.delete(np.arange(40), [3, 17])
    labels, distance = clusters.nearest(vectors)
    expected, half = ref.nearest_vectors(points, vectors)
    np.testing.assert_array_equal(labels[others], expected[others])
    np.testing.assert_array_equal(distance[others], half[others])
    assert (labels[[3, 17]] == 0).all()
    np.testing.assert_array_equal(clusters.sums(labels, 11), ref.member_sums(broken, labels, 11))


def test_vectors_of_several_launches(device, rng):
    points, vectors = whole(rng, 20, 3), whole(rng, 2 * AT_ONCE + 3, 3)
    labels, distance = DeviceClusters(device, points).nearest(vectors)
    expected, apart = HostClusters(points).nearest(vectors)
    np.testing.assert_array_equal(labels, expected)
    np.testing.assert_array_equal(distance, apart)


@pytest.mark.parametrize(("count", "entries"), [(1, 1), (17, 9), (130, 40)])
def test_vector_with_the_largest_product_is_found_in_blocks(device, rng, count, entries, monkeypatch):
    points, vectors = (rng.normal(size=(rows, 165)).astype(np.float32) for rows in (count, entries))
    products = points.astype(np.float64) @ vectors.T.astype(np.float64)
    whole = most_alike(device, points, vectors)
    np.testing.assert_allclose(products[np.arange(count), whole], products.max(axis=1), rtol=1e-5)
    monkeypatch.setattr("clsplat.gaussians.clusters.BLOCK", 64)
    np.testing.assert_array_equal(most_alike(device, points, vectors), whole)


@pytest.mark.parametrize(("count", "entries"), [(1, 1), (100, 64), (3000, 64)])
def test_a_palette_is_the_same_bits_with_and_without_a_device(device, rng, count, entries):
    points = rng.normal(size=(count, 24)).astype(np.float32)
    for found, expected in zip(
        palette(points, entries, partial(DeviceClusters, device)), palette(points, entries), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.large
def test_sog_harmonics_are_equal_with_and_without_a_device(device, rng):
    rest = splats(rng, 1100, 3).parameters["sh_rest"]
    host, other = Harmonics.of(rest, "balanced"), Harmonics.of(rest, "balanced", partial(DeviceClusters, device))
    for name in ("numbers", "palette", "labels"):
        np.testing.assert_array_equal(getattr(other, name), getattr(host, name))
