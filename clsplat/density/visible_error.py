"""How much errors of spherical harmonics show in the training views, and a palette of harmonics that shows few.

A Gaussian is seen from some directions only.  With Y(d) the harmonics of the bands above 0 in a direction, an error e
of its coefficients changes its color there by Y(d) . e, of which the band 0 takes up the mean m . e.  Over the views,
by the Gaussian's weight w in each, the square of what is left is e^T A e, with A = sum w (Y - m) (Y - m)^T.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.core.harmonics import basis
from clsplat.density.survey import WEIGHT, SurveyView
from clsplat.formats.splats import SH_C0

Floats = NDArray[np.float64]
Nearest = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.int64]]
UNSEEN = 0.05  # weight of all directions alike beside those that are seen; from 0.01 to 0.05 lego has the same errors
FAINT = 1.0e-3  # of the mean weight, which a Gaussian has that no view shows
ROUNDS = 4  # of Lloyd's iteration; the fifth lowers the error of lego by 0.6 %


@dataclass(frozen=True)
class VisibleError:
    """The quadratic forms of N Gaussians with K coefficients above band 0."""

    weights: Floats  # [N] blend weights over the views' pixels
    mean: Floats  # [N,K] of the harmonics in the directions seen
    form: Floats  # [K(K+1)/2,N] upper triangle of A, plus the share of all directions

    @classmethod
    def of(
        cls, looks: Iterable[tuple[SurveyView, NDArray[np.floating]]], means: NDArray[np.floating], coefficients: int
    ) -> "VisibleError":
        """Sum over views, each with the center of its camera, [3].  means: [N,3] scene units."""
        i, j = np.triu_indices(coefficients)
        weights, first = np.zeros(len(means)), np.zeros((coefficients, len(means)))
        second = np.zeros((len(i), len(means)))
        for look, position in looks:
            weight, directions = look.sum(WEIGHT).astype(np.float64), means - position
            directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
            harmonics = np.ascontiguousarray(basis(directions)[:, :coefficients].T)
            weighted = weight * harmonics
            weights, first = weights + weight, first + weighted
            for place, (row, column) in enumerate(zip(i, j, strict=True)):
                second[place] += weighted[row] * harmonics[column]
        mean = first / np.where(weights > 0, weights, 1)
        for place, (row, column) in enumerate(zip(i, j, strict=True)):
            second[place] -= mean[row] * first[column]
        second[i == j] += UNSEEN / (4 * np.pi) * (weights + FAINT * weights.mean())  # |e|^2 / 4 pi over the sphere
        return cls(weights, np.ascontiguousarray(mean.T), second)

    def gradient(self, rest: NDArray[np.floating]) -> Floats:
        """Return A x for coefficients, [N, 3 K], of three channels."""
        table, products = (
            rest.reshape(len(rest), -1, 3).astype(np.float64),
            np.zeros((len(rest), self.mean.shape[1], 3)),
        )
        for place, (row, column) in enumerate(zip(*np.triu_indices(table.shape[1]), strict=True)):
            products[:, row] += self.form[place, :, None] * table[:, column]
            if row != column:
                products[:, column] += self.form[place, :, None] * table[:, row]
        return products.reshape(rest.shape)

    def base_change(self, error: NDArray[np.floating]) -> Floats:
        """Return the change of band 0, [N,3], that takes up an error of the others, [N, 3 K]."""
        channels = error.reshape(len(error), -1, 3)
        return np.asarray((self.mean[:, :, None] * channels).sum(axis=1) / SH_C0)

    def palette(
        self, rest: NDArray[np.float32], vectors: Floats, *, nearest: Nearest
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Return vectors [E, 3 K] that show less of their error than those given, and the vector of each Gaussian, [N].

        Lloyd's iteration with the form of each Gaussian as its distance.  nearest: of points [N, c] and vectors [E, c]
        the one with the largest product.  A vector without Gaussians stays.
        """
        products = self.gradient(rest)
        points = self._points(products)
        for _ in range(ROUNDS):
            labels = nearest(points, _with_squares(vectors))
            vectors = self._minima(products, labels, vectors)
        return vectors, nearest(points, _with_squares(vectors))

    def _points(self, products: Floats) -> NDArray[np.float32]:
        """What a vector with its squares is multiplied by, [N, 3 K + K(K+1)/2], column by column: memory is short."""
        count, own = products.shape
        i, j = np.triu_indices(self.mean.shape[1])
        scale = 1 / np.maximum(self.weights + FAINT * self.weights.mean(), 1e-30)
        points = np.empty((count, own + len(i)), np.float32)
        for column in range(own):
            points[:, column] = products[:, column] * scale
        for place, factor in enumerate(np.where(i == j, -0.5, -1.0)):
            points[:, own + place] = self.form[place] * factor * scale
        return points

    def _minima(self, products: Floats, labels: NDArray[np.int64], vectors: Floats) -> Floats:
        """The vector of each label whose error shows least, sums in the order of the Gaussians."""
        entries, size = len(vectors), self.mean.shape[1]
        i, j = np.triu_indices(size)
        form, right = np.empty((entries, size, size)), np.empty(vectors.shape)
        for place, (row, column) in enumerate(zip(i, j, strict=True)):
            sums = np.bincount(labels, self.form[place], minlength=entries)
            form[:, row, column] = form[:, column, row] = sums
        for component in range(vectors.shape[1]):
            right[:, component] = np.bincount(labels, products[:, component], minlength=entries)
        held, moved = np.bincount(labels, minlength=entries) > 0, vectors.copy()
        solved = np.linalg.solve(form[held], right[held].reshape(-1, size, 3))
        moved[held] = solved.reshape(-1, 3 * size)
        return moved


def _with_squares(vectors: Floats) -> NDArray[np.float32]:
    """Vectors, and beside them the products of their coefficients that the form multiplies, summed over channels."""
    table = vectors.reshape(len(vectors), -1, 3)
    i, j = np.triu_indices(table.shape[1])
    return np.concatenate([vectors, (table[:, i] * table[:, j]).sum(axis=2)], axis=1).astype(np.float32)
