"""k-means (Lloyd 1982), one point at a time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def nearest_vectors(points: NDArray[Any], vectors: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The nearest vector of each point, the first of equally near ones, and half the squared distance, both [N].

    points: [N,c], vectors: [E,c].  A point that is not a number has the label 0 and the distance inf.
    """
    labels, distances = np.zeros(len(points), int), np.full(len(points), np.inf)
    for i, point in enumerate(points.astype(np.float64)):
        for label, vector in enumerate(vectors.astype(np.float64)):
            distance = np.sum((point - vector) ** 2) / 2
            if distance < distances[i]:
                labels[i], distances[i] = label, distance
    return labels, distances


def member_sums(points: NDArray[Any], labels: NDArray[Any], entries: int) -> NDArray[Any]:
    """The sum of the points of each label, [entries,c]; what is not a number counts as 0."""
    sums = np.zeros((entries, points.shape[1]))
    for point, label in zip(points.astype(np.float64), labels, strict=True):
        sums[label] += np.nan_to_num(point, nan=0)
    return sums


def shared_means(values: NDArray[Any], labels: NDArray[Any], weights: NDArray[Any]) -> NDArray[Any]:
    """Each row replaced by the mean of the rows that have its label, by weight, [N,c].

    values: [N,c], labels, weights: [N].  Where all weights of a label are zero it is the first of its rows.
    """
    shared = np.empty(values.shape)
    for label in np.unique(labels):
        members = np.flatnonzero(labels == label)
        rows, weight = values[members].astype(np.float64), weights[members].astype(np.float64)
        shared[members] = weight @ rows / weight.sum() if weight.any() else rows[0]
    return shared
