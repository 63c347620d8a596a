"""Palette vectors: the vector of each row, at the edges of groups and lanes, and means of rows that share one."""

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.gaussians.gaussians import Gaussians
from clsplat.stages.palette import average_clusters, find_most_similar, set_clusters
from tests.support.devices import each_once, on_devices, on_one_setting


@on_devices("count, entries", [(1, 1), (16, 8), (17, 9), (130, 40)])
def test_vector_with_the_largest_product_is_found_in_blocks(device, rng, count, entries, monkeypatch):
    points, vectors = (rng.normal(size=(rows, 165)).astype(np.float32) for rows in (count, entries))
    products = points.astype(np.float64) @ vectors.T.astype(np.float64)
    whole = find_most_similar(device, points, vectors)
    np.testing.assert_allclose(products[np.arange(count), whole], products.max(axis=1), rtol=1e-5)
    monkeypatch.setattr("clsplat.stages.palette.BLOCK", 64)
    np.testing.assert_array_equal(find_most_similar(device, points, vectors), whole)


def clustered(device, rng, count: int, clusters: int) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    gaussians = random_case(rng, count).model(device).gaussians
    labels, weights = rng.integers(0, clusters, count), rng.random(count).astype(np.float32)
    set_clusters(gaussians, labels, weights)
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
    average_clusters(gaussians, name)
    np.testing.assert_allclose(gaussians.get(name), expected, rtol=1e-5, atol=1e-6)
    assert len(np.unique(gaussians.get(name), axis=0)) == len(np.unique(labels))
    np.testing.assert_array_equal(gaussians.get("means"), others)


@on_one_setting
def test_equal_rows_do_not_change(device, rng):
    gaussians, _, _ = clustered(device, rng, 70, 6)
    average_clusters(gaussians, "sh_rest")
    before = gaussians.get("sh_rest")
    average_clusters(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest"), before)


@on_one_setting
def test_cluster_without_weight_gets_its_first_row(device, rng):
    gaussians, labels, weights = clustered(device, rng, 40, 4)
    weights[labels == 2] = 0
    set_clusters(gaussians, labels, weights)
    before = gaussians.get("sh_rest")[labels == 2]
    average_clusters(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest")[labels == 2], np.broadcast_to(before[0], before.shape))


@on_one_setting
def test_cluster_of_a_gaussian_moves_with_it(device, rng):
    gaussians, labels, _ = clustered(device, rng, 50, 5)
    source = rng.permutation(50)[:30]
    gaussians.rearrange(device.upload(source.astype(np.uint32)), device.zeros(30, np.uint32), 30)
    average_clusters(gaussians, "sh_rest")
    for label in np.unique(labels[source]):
        assert len(np.unique(gaussians.get("sh_rest")[labels[source] == label], axis=0)) == 1
