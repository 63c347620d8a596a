"""Rows of Gaussians that share a vector: the float64 means, with the same bits each time."""

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.scenes import random_case
from clsplat.gaussians import members
from clsplat.gaussians.tables import Gaussians


def clustered(device, rng, count: int, clusters: int) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    gaussians = random_case(rng, count).model(device).gaussians
    labels, weights = rng.integers(0, clusters, count), rng.random(count).astype(np.float32)
    members.set_clusters(gaussians, labels, weights)
    return gaussians, labels, weights


@pytest.mark.parametrize(
    ("count", "clusters"), [(1, 1), (15, 3), (16, 16), (17, 1), (64, 65), (65, 9), (300, 2), (129, 200)]
)
@pytest.mark.parametrize("name", ["sh_rest", "logit_opacity"])
def test_each_row_becomes_the_weighted_mean_of_its_cluster(device, rng, count, clusters, name):
    gaussians, labels, weights = clustered(device, rng, count, clusters)
    expected = ref.shared_means(gaussians.get(name), labels, weights)
    others = gaussians.get("means")
    members.share(gaussians, name)
    np.testing.assert_allclose(gaussians.get(name), expected, rtol=1e-5, atol=1e-6)
    assert len(np.unique(gaussians.get(name), axis=0)) == len(np.unique(labels))
    np.testing.assert_array_equal(gaussians.get("means"), others)


def test_rows_that_are_equal_stay_as_they_are(device, rng):
    gaussians, _, _ = clustered(device, rng, 70, 6)
    members.share(gaussians, "sh_rest")
    before = gaussians.get("sh_rest")
    members.share(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest"), before)


def test_a_cluster_without_weight_gets_its_first_row(device, rng):
    gaussians, labels, weights = clustered(device, rng, 40, 4)
    weights[labels == 2] = 0
    members.set_clusters(gaussians, labels, weights)
    before = gaussians.get("sh_rest")[labels == 2]
    members.share(gaussians, "sh_rest")
    np.testing.assert_array_equal(gaussians.get("sh_rest")[labels == 2], np.broadcast_to(before[0], before.shape))


def test_the_cluster_of_a_gaussian_moves_with_it(device, rng):
    gaussians, labels, _ = clustered(device, rng, 50, 5)
    source = rng.permutation(50)[:30]
    gaussians.rearrange(device.upload(source.astype(np.uint32)), device.zeros(30, np.uint32), 30)
    members.share(gaussians, "sh_rest")
    for label in np.unique(labels[source]):
        assert len(np.unique(gaussians.get("sh_rest")[labels[source] == label], axis=0)) == 1
