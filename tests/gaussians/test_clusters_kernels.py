"""k-means: exact whole numbers, at the edges of groups and lanes, and the same file with and without a device.

The means of rows that share a vector have the same bits each time.
"""

from functools import partial

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.formats.palette import LEVELS, HostClusters, palette
from clsplat.formats.sog import Harmonics
from clsplat.gaussians import clusters as members
from clsplat.gaussians.clusters import AT_ONCE, DeviceClusters, most_alike
from clsplat.gaussians.gaussians import Gaussians
from tests.support.devices import each_once, on_devices, on_one_setting
from tests.support.models import splats


def whole(rng: np.random.Generator, rows: int, components: int, most: int = LEVELS) -> np.ndarray:
    return rng.integers(-most, most + 1, (rows, components)).astype(np.float32)


@on_devices(
    "count, entries, components",
    each_once([(0, 1), (1, 1), (15, 7), (16, 8), (17, 9), (64, 16), (65, 3), (129, 33)], [3, 9, 45]),
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


@on_devices("count, entries", [(1, 1), (17, 9), (130, 40)])
def test_vector_with_the_largest_product_is_found_in_blocks(device, rng, count, entries, monkeypatch):
    points, vectors = (rng.normal(size=(rows, 165)).astype(np.float32) for rows in (count, entries))
    products = points.astype(np.float64) @ vectors.T.astype(np.float64)
    whole = most_alike(device, points, vectors)
    np.testing.assert_allclose(products[np.arange(count), whole], products.max(axis=1), rtol=1e-5)
    monkeypatch.setattr("clsplat.gaussians.clusters.BLOCK", 64)
    np.testing.assert_array_equal(most_alike(device, points, vectors), whole)


@on_devices("count, entries", [(1, 1), (100, 64), (3000, 64)])
def test_a_palette_is_the_same_bits_with_and_without_a_device(device, rng, count, entries):
    points = rng.normal(size=(count, 24)).astype(np.float32)
    for found, expected in zip(
        palette(points, entries, partial(DeviceClusters, device)), palette(points, entries), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.large
@on_one_setting
def test_sog_harmonics_are_equal_with_and_without_a_device(device, rng):
    rest = splats(rng, 1100, 3).parameters["sh_rest"]
    host, other = Harmonics.of(rest, "balanced"), Harmonics.of(rest, "balanced", partial(DeviceClusters, device))
    for name in ("numbers", "palette", "labels"):
        np.testing.assert_array_equal(getattr(other, name), getattr(host, name))


def clustered(device, rng, count: int, clusters: int) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    gaussians = random_case(rng, count).model(device).gaussians
    labels, weights = rng.integers(0, clusters, count), rng.random(count).astype(np.float32)
    members.set_clusters(gaussians, labels, weights)
    return gaussians, labels, weights


@on_devices(
    "count, clusters, name",
    each_once(
        [(1, 1), (15, 3), (16, 16), (17, 1), (64, 65), (65, 9), (300, 2), (129, 200)], ["sh_rest", "logit_opacity"]
    ),
)
def test_each_row_becomes_the_weighted_mean_of_its_cluster(device, rng, count, clusters, name):
    gaussians, labels, weights = clustered(device, rng, count, clusters)
    expected = ref.shared_means(gaussians.get(name), labels, weights)
    others = gaussians.get("means")
    members.share(gaussians, name)
    np.testing.assert_allclose(gaussians.get(name), expected, rtol=1e-5, atol=1e-6)
    assert len(np.unique(gaussians.get(name), axis=0)) == len(np.unique(labels))
    np.testing.assert_array_equal(gaussians.get("means"), others)


@on_one_setting
def test_rows_that_are_equal_stay_as_they_are(device, rng):
    gaussians, _, _ = clustered(device, rng, 70, 6)
    members.share(gaussians, "sh_rest")
    before = gaussians.get("sh_rest")
    members.share(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest"), before)


@on_one_setting
def test_a_cluster_without_weight_gets_its_first_row(device, rng):
    gaussians, labels, weights = clustered(device, rng, 40, 4)
    weights[labels == 2] = 0
    members.set_clusters(gaussians, labels, weights)
    before = gaussians.get("sh_rest")[labels == 2]
    members.share(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest")[labels == 2], np.broadcast_to(before[0], before.shape))


@on_one_setting
def test_the_cluster_of_a_gaussian_moves_with_it(device, rng):
    gaussians, labels, _ = clustered(device, rng, 50, 5)
    source = rng.permutation(50)[:30]
    gaussians.rearrange(device.upload(source.astype(np.uint32)), device.zeros(30, np.uint32), 30)
    members.share(gaussians, "sh_rest")
    for label in np.unique(labels[source]):
        assert len(np.unique(gaussians.get("sh_rest")[labels[source] == label], axis=0)) == 1
