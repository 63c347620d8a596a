"""Gaussians in clusters whose members share values; which cluster, and with which weight, is in tables beside them."""

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.tables import Gaussians

LABEL, WEIGHT = "cluster/label", "cluster/weight"  # [1] a whole number below 2^24, [1] at least 0


def set_clusters(gaussians: Gaussians, labels: NDArray[np.integer], weights: NDArray[np.floating]) -> None:
    """Note the cluster of each Gaussian, [N], and how much it counts there, [N]."""
    for name, column in ((LABEL, labels), (WEIGHT, weights)):
        if name not in gaussians.tables:
            gaussians.add(name, 1)
        gaussians.set(name, column[:, None])


def share(gaussians: Gaussians, name: str) -> None:
    """Replace each row of a table by the weighted mean of its cluster's rows, summed in their order."""
    labels = gaussians.get(LABEL)[:, 0].astype(np.int64)
    order, first = np.argsort(labels, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(labels))])
    gaussians.device.program("members.cl").share_mean(
        items=(len(first) - 1, gaussians.tables[name].components),
        values=gaussians[name],
        weight=gaussians[WEIGHT],
        member=gaussians.device.upload(order.astype(np.uint32)),
        first=gaussians.device.upload(first.astype(np.uint32)),
        stride=gaussians.capacity,
        clusters=len(first) - 1,
    )
