"""Quantize harmonics and tables for SOG: build a palette, train it, and round tables."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import pluralize
from clsplat.core.harmonics import basis
from clsplat.density.survey import WEIGHT, RenderedView
from clsplat.formats.sog import Harmonics
from clsplat.formats.sog_quantize import (
    log_weights,
    round_means,
    round_quats,
    round_to,
)
from clsplat.formats.splats import SH_C0, Quality
from clsplat.gaussians.gaussians import ALIGNMENT, Gaussians
from clsplat.opencl.device import Device, constants
from clsplat.training.run import Run
from clsplat.training.stage import ALL_HARMONICS, Scheduled, Stage

LOG = logging.getLogger("clsplat")
FILE = "clusters.cl"
TOGETHER = int(constants(FILE)["TOGETHER"])
BLOCK = 1 << 16  # points on the device at a time, since points have many components
VECTORS_PER_LAUNCH = 1024  # vectors per kernel launch, which fit in the cache of a core
Floats = NDArray[np.float64]
Nearest = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.int64]]
UNSEEN_WEIGHT = 0.05  # weight of all directions relative to the observed ones; 0.01 to 0.05 give lego the same errors
MIN_WEIGHT = 1.0e-3  # weight of a Gaussian that no view shows, as a fraction of the mean weight
LLOYD_ITERATIONS = 4  # iterations of Lloyd's algorithm; a fifth lowers the error of lego by 0.6 %


class PaletteSh(Scheduled):
    """Replace the harmonics of each Gaussian with a vector of a palette, as SOG stores them.

    The palette minimizes the errors that are visible in the training views: those in the directions from which the
    Gaussian is seen, weighted by its contribution, after the base color has been adapted to absorb part of them.
    Training with a rate of 0 for `sh_rest` then adapts the other tables, and the SOG stores the harmonics without loss.
    Harmonics that already form a palette keep it, rounded to the numbers that SOG can store.
    """

    stage: Literal["palette_sh"] = "palette_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"palette"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"quality", "step"})

    quality: Quality = "balanced"
    """Quality of the SOG: `small`, `balanced` or `high`, with at most 1,024, 4,096 or 16,384 vectors, respectively."""
    step: Annotated[float, Field(gt=0)] | None = None
    """Step to which the coefficients are rounded if at most 256 values result; larger steps make smaller files."""

    def frozen_parameters(self, run: Run) -> Collection[str]:
        return "sh_base", "sh_rest"

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        if not gaussians.sh_degree:
            return
        sh_rest, error = gaussians.get("sh_rest"), visible_error(run)
        improve = partial(error.improve_palette, sh_rest, nearest=partial(find_most_similar, run.device))
        harmonics = Harmonics.fit(sh_rest, self.quality, error.weights, improve, self.step)
        gaussians.set("sh_rest", harmonics.values)
        gaussians.set("sh_base", gaussians.get("sh_base") + error.base_change(sh_rest - harmonics.values))
        set_clusters(gaussians, harmonics.labels, error.weights)
        if run.adam is not None:
            run.adam.reset_moments("sh_rest")
        vectors = pluralize(len(harmonics.palette), "vector")
        LOG.info("built a palette of %s for %s", vectors, pluralize(gaussians.count, "Gaussian"))


class SharePalette(Scheduled):
    """Set each vector of the palette, and the harmonics of its Gaussians, to the mean of these Gaussians' harmonics.

    The mean is weighted by the Gaussians' contributions to the training views at the time when `palette_sh` built the
    palette.  With a cadence and a rate for `sh_rest`, this trains the vectors.  Also run the stage right after that
    training, since no edit follows the last step.
    """

    stage: Literal["share_palette"] = "share_palette"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "palette"})
    edits: ClassVar[bool] = True
    conflicts = ALL_HARMONICS

    def active_conflicts(self) -> Mapping[str, str]:
        return self.conflicts if self.every else {}  # no conflict after a training

    def run(self, run: Run) -> None:
        if run.model.gaussians.sh_degree:
            average_clusters(run.model.gaussians, "sh_rest")


def find_most_similar(device: Device, points: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index of the vector, [E, c], with the largest dot product for each point, [N, c].

    The first of equal vectors is chosen.
    """
    blocks = (points[start : start + BLOCK] for start in range(0, len(points), BLOCK))
    return np.concatenate([_find_most_similar(device, block, vectors) for block in blocks])


def _find_most_similar(device: Device, points: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
    count, components = points.shape
    stride = -(-count // ALIGNMENT) * ALIGNMENT
    planes = np.zeros((components, stride), np.float32)
    planes[:, :count] = points.T
    entries = -(-len(vectors) // TOGETHER) * TOGETHER
    # padded with copies of the first vector, which are never chosen, since the first of equal vectors is
    host_vectors = np.concatenate([vectors, np.repeat(vectors[:1], entries - len(vectors), axis=0)])
    label, largest = device.empty(stride), device.empty(stride)
    device_points, all_vectors = device.upload(planes), device.upload(np.ascontiguousarray(host_vectors, np.float32))
    for first in range(0, entries, VECTORS_PER_LAUNCH):
        device.program(FILE).most_alike(
            items=-(-count // int(device.tuning["LANES"])),
            points=device_points,
            vectors=all_vectors,
            label=label,
            largest=largest,
            components=components,
            first=first,
            end=min(first + VECTORS_PER_LAUNCH, entries),
            stride=stride,
            count=count,
        )
    return label.get()[:count].astype(np.int64)


@dataclass(frozen=True)
class VisibleError:
    """How visible errors of the SH coefficients are in the training views; N Gaussians, K coefficients above band 0.

    A Gaussian is visible only from some directions.  With Y(d) the harmonics above band 0 in direction d, an error e of
    its coefficients changes its color there by Y(d) . e, and band 0 can absorb the mean m . e.  Summed over the views
    with the Gaussian's weight w in each, the square of the remainder is e^T A e, A = sum w (Y - m) (Y - m)^T.
    """

    weights: Floats  # [N] blend weights, summed over the pixels of the views
    mean: Floats  # [N, K] mean of the harmonics over the observed directions
    form: Floats  # [K(K+1)/2, N] upper triangle of A, regularized by all directions

    @classmethod
    def from_views(
        cls, views: Iterable[tuple[RenderedView, NDArray[np.floating]]], means: NDArray[np.floating], coefficients: int
    ) -> "VisibleError":
        """Accumulate A over `views`: pairs of a render and a camera center, [3].  means: [N, 3] in scene units."""
        i, j = np.triu_indices(coefficients)
        weights, first = np.zeros(len(means)), np.zeros((coefficients, len(means)))
        second = np.zeros((len(i), len(means)))
        for view, position in views:
            weight, directions = view.sum(WEIGHT).astype(np.float64), means - position
            directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
            harmonics = np.ascontiguousarray(basis(directions)[:, :coefficients].T)
            products = weight * harmonics
            weights, first = weights + weight, first + products
            for index, (row, column) in enumerate(zip(i, j, strict=True)):
                second[index] += products[row] * harmonics[column]
        mean = first / np.where(weights > 0, weights, 1)
        for index, (row, column) in enumerate(zip(i, j, strict=True)):
            second[index] -= mean[row] * first[column]
        # |e|^2 / 4 pi over the sphere
        second[i == j] += UNSEEN_WEIGHT / (4 * np.pi) * (weights + MIN_WEIGHT * weights.mean())
        return cls(weights, np.ascontiguousarray(mean.T), second)

    def gradient(self, sh_rest: NDArray[np.floating]) -> Floats:
        """Return the gradient A x of the error at coefficients x of three channels, [N, 3 K]; A is `form`."""
        table, products = (
            sh_rest.reshape(len(sh_rest), -1, 3).astype(np.float64),
            np.zeros((len(sh_rest), self.mean.shape[1], 3)),
        )
        for index, (row, column) in enumerate(zip(*np.triu_indices(table.shape[1]), strict=True)):
            products[:, row] += self.form[index, :, None] * table[:, column]
            if row != column:
                products[:, column] += self.form[index, :, None] * table[:, row]
        return products.reshape(sh_rest.shape)

    def base_change(self, error: NDArray[np.floating]) -> Floats:
        """Return the change of band 0, [N, 3], that best compensates an error of the other bands, [N, 3 K]."""
        channels = error.reshape(len(error), -1, 3)
        return np.asarray((self.mean[:, :, None] * channels).sum(axis=1) / SH_C0)

    def improve_palette(
        self, sh_rest: NDArray[np.float32], vectors: Floats, *, nearest: Nearest
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Return a palette's vectors, [E, 3 K], optimized for less visible errors, and the label of each Gaussian, [N].

        This is Lloyd's iteration with the quadratic form of each Gaussian as its distance.  nearest: returns for
        points, [N, c], the index of the vector, [E, c], with the largest dot product.  Unused vectors do not change.
        """
        products = self.gradient(sh_rest)
        points = self._points(products)
        for _ in range(LLOYD_ITERATIONS):
            labels = nearest(points, _append_products(vectors))
            vectors = self._optimal_vectors(products, labels, vectors)
        return vectors, nearest(points, _append_products(vectors))

    def _points(self, products: Floats) -> NDArray[np.float32]:
        """Return the points whose dot products `nearest` compares, [N, 3 K + K(K+1)/2]."""
        count, vector_size = products.shape
        i, j = np.triu_indices(self.mean.shape[1])
        scale = 1 / np.maximum(self.weights + MIN_WEIGHT * self.weights.mean(), 1e-30)
        points = np.empty((count, vector_size + len(i)), np.float32)
        for column in range(vector_size):  # one column at a time, to save memory
            points[:, column] = products[:, column] * scale
        for index, factor in enumerate(np.where(i == j, -0.5, -1.0)):
            points[:, vector_size + index] = self.form[index] * factor * scale
        return points

    def _optimal_vectors(self, products: Floats, labels: NDArray[np.int64], vectors: Floats) -> Floats:
        """Return the optimal vector for the Gaussians of each label.  Sums are computed in Gaussian order."""
        entries, size = len(vectors), self.mean.shape[1]
        i, j = np.triu_indices(size)
        form, right_sides = np.empty((entries, size, size)), np.empty(vectors.shape)
        for index, (row, column) in enumerate(zip(i, j, strict=True)):
            sums = np.bincount(labels, self.form[index], minlength=entries)
            form[:, row, column] = form[:, column, row] = sums
        for component in range(vectors.shape[1]):
            right_sides[:, component] = np.bincount(labels, products[:, component], minlength=entries)
        is_used, minima = np.bincount(labels, minlength=entries) > 0, vectors.copy()
        solutions = np.linalg.solve(form[is_used], right_sides[is_used].reshape(-1, size, 3))
        minima[is_used] = solutions.reshape(-1, 3 * size)
        return minima


def _append_products(vectors: Floats) -> NDArray[np.float32]:
    """Append to each vector the products of its pairs of coefficients, summed over the channels."""
    table = vectors.reshape(len(vectors), -1, 3)
    i, j = np.triu_indices(table.shape[1])
    return np.concatenate([vectors, (table[:, i] * table[:, j]).sum(axis=2)], axis=1).astype(np.float32)


def visible_error(run: Run) -> VisibleError:
    """Measure how visible errors of the SH coefficients are in the training views."""
    views, gaussians = run.scene.split("train"), run.model.gaussians
    renders = run.survey().render(run.status.counted(views, "views", len(views)))
    positions = (view.position for view in views)
    coefficients = gaussians.tables["sh_rest"].components // 3
    return VisibleError.from_views(zip(renders, positions, strict=False), gaussians.get("means"), coefficients)


# Clusters of Gaussians that share values: tables contain the cluster and the weight of each Gaussian.

LABEL, CLUSTER_WEIGHT = "cluster/label", "cluster/weight"  # [1] an integer below 2^24, [1] at least 0


def set_clusters(gaussians: Gaussians, labels: NDArray[np.integer], weights: NDArray[np.floating]) -> None:
    """Store the cluster of each Gaussian, [N], and its weight in the cluster, [N]."""
    for name, column in ((LABEL, labels), (CLUSTER_WEIGHT, weights)):
        if name not in gaussians.tables:
            gaussians.add(name, 1)
        gaussians.set(name, column[:, None])


def average_clusters(gaussians: Gaussians, name: str) -> None:
    """Replace each row of a table with the weighted mean of its cluster's rows, summed in row order."""
    labels = gaussians.get(LABEL)[:, 0].astype(np.int64)
    order, first = np.argsort(labels, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(labels))])
    gaussians.device.program("members.cl").share_mean(
        items=(len(first) - 1, gaussians.tables[name].components),
        values=gaussians[name],
        weight=gaussians[CLUSTER_WEIGHT],
        member=gaussians.device.upload(order.astype(np.uint32)),
        first=gaussians.device.upload(first.astype(np.uint32)),
        stride=gaussians.capacity,
        clusters=len(first) - 1,
    )


# Tables with fewer distinct values, which SOG stores in fewer bytes.

Step = Annotated[float, Field(gt=0)]
Levels = Annotated[int, Field(ge=1, le=64)]


class RoundTables(Stage):
    """Round tables to steps, so that SOG stores them in fewer bytes.

    Tables without a step do not change.  Training with rates of 0 for the rounded tables then adapts the others.
    """

    stage: Literal["round_tables"] = "round_tables"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"means", "quats", "log_scales", "sh_base"})

    means: Step | None = None
    """Step of positions, as a fraction of the size of each Gaussian (the geometric mean of three standard deviations);
    larger for Gaussians of little weight."""
    quats: Levels | None = None
    """Step of rotations, in 8-bit levels.  The axes of each Gaussian are first permuted so that its rotation is
    minimal."""
    log_scales: Step | None = None
    """Step of the logarithms of standard deviations."""
    sh_base: Step | None = None
    """Step of the coefficients of band 0; 1 changes a color by 0.28."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        tables = {name: gaussians.get(name) for name in self._rounded_tables()}
        if self.means:
            params = {name: gaussians.get(name) for name in ("means", "log_scales", "logit_opacity")}
            tables["means"] = round_means(params["means"], params["log_scales"], log_weights(params), self.means)
        if self.quats:
            tables["quats"], tables["log_scales"] = round_quats(tables["quats"], tables["log_scales"], self.quats)
        if self.log_scales:
            tables["log_scales"] = round_to(tables["log_scales"], self.log_scales)
        if self.sh_base:
            tables["sh_base"] = round_to(tables["sh_base"], self.sh_base)
        for name, table in tables.items():
            gaussians.set(name, table)
        run.refresh_filter()

    def _rounded_tables(self) -> Collection[str]:
        steps = {
            "means": self.means,
            "quats": self.quats,
            "log_scales": self.log_scales or self.quats,
            "sh_base": self.sh_base,
        }
        return [name for name, step in steps.items() if step]
