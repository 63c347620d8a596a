"""Find similar photographs: bags of visual words (Sivic and Zisserman 2003), learnt from these photographs."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

WORDS = 1024
SAMPLES = 40  # descriptors for each word, from which the words are learnt
ROUNDS = 10  # of k-means


def alike(tables: Sequence[NDArray[np.float32]], neighbours: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of each photograph with the `neighbours` most similar ones, by `likeness`."""
    close = likeness(tables)
    np.fill_diagonal(close, -1)
    nearest = np.argsort(-close, axis=1, kind="stable")[:, : min(neighbours, len(tables) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row})


def likeness(tables: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return how alike photographs are, 0 to 1, [N, N].

    tables: descriptors [M, 128] of each photograph.  A word is a cell of k-means over a sample of the descriptors;
    photographs are compared by the cosine of their TF-IDF vectors.  Photographs without descriptors are like none.
    """
    rng = np.random.default_rng(0)
    sample = np.concatenate(
        [table[rng.permutation(len(table))[: SAMPLES * WORDS // len(tables) + 1]] for table in tables]
    )
    if not len(sample):
        return np.zeros((len(tables), len(tables)))
    counts = np.zeros((len(tables), WORDS))
    words = _words(sample)
    for row, table in enumerate(tables):
        if len(table):
            distance = (words**2).sum(axis=1) - 2 * table @ words.T
            counts[row] += np.bincount(distance.argmin(axis=1), minlength=WORDS)
    rarity = np.log(len(tables) / np.maximum((counts > 0).sum(axis=0), 1))
    vectors = counts * rarity
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors @ vectors.T)


def _words(sample: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centres of k-means, [at most WORDS, 128]."""
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0)
    count, labels = min(WORDS, len(sample)), np.empty(0, np.int32)
    _, _, words = cv2.kmeans(sample, count, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.asarray(words, np.float32)
