"""Add Gaussians in dense regions with large gradients (an interpretation of GDGS, Wang and Shan 2025)."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.quaternions import rotation_matrix
from clsplat.core.schedule import NonNegative, Positive
from clsplat.density.edit import Edit, Rule

Floats = NDArray[np.float64]
GRID_QUANTILES = (0.01, 0.99)  # the grid spans these quantiles of the means along each axis


class CloneDense(Rule):
    """Copy small Gaussians with large gradients in dense regions twice: at the same position, and with jitter.

    A grid of `cells`³ covers the central 98 % of the means.  The rule acts only in the `extremes` fullest cells, if
    they have at least `ratio_above` times as many Gaussians with large gradients as the `extremes` emptiest cells.
    List this rule before `clone`, which then copies the other Gaussians.
    """

    type: Literal["clone_dense"] = "clone_dense"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"gradient_above", "size_below", "ratio_above", "jitter", "cells", "extremes"}
    )

    gradient_above: Positive = 2.0e-4
    """Smallest mean of `screen_grad` at which a Gaussian is copied."""
    size_below: Positive = 0.01
    """Size up to which a Gaussian is copied: largest standard deviation as a fraction of the scene extent."""
    ratio_above: NonNegative = 400.0
    """Smallest ratio of the counts in the fullest cells to those in the emptiest."""
    jitter: NonNegative = 0.5
    """Standard deviation of the jitter, in standard deviations of the Gaussian along its axes."""
    cells: Annotated[int, Field(ge=1, le=256)] = 4
    """Number of grid cells along each axis."""
    extremes: Annotated[int, Field(ge=1)] = 20
    """Number of fullest cells, and of emptiest cells, that are compared."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_grad"}

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        means = gaussians.get("means").astype(np.float64)
        scales = np.exp(gaussians.get("log_scales").astype(np.float64))
        has_gradient = edit.stats.mean("screen_grad") >= edit.evaluate(self.gradient_above)
        cell = grid_cells(means, self.cells)
        counts = np.bincount(cell[has_gradient & (cell >= 0)], minlength=self.cells**3)
        order = np.argsort(-counts, kind="stable")
        densest, sparsest = order[: self.extremes], order[-self.extremes :]
        if counts[densest].sum() < edit.evaluate(self.ratio_above) * max(counts[sparsest].sum(), 1):
            return
        is_small = scales.max(axis=1, initial=0) <= edit.evaluate(self.size_below) * edit.scene_scale.extent
        is_copied = has_gradient & is_small & np.isin(cell, densest) & (edit.row_counts() == 1)
        rows = np.flatnonzero(is_copied)
        quats = gaussians.get("quats")[rows].astype(np.float64)
        axes = rotation_matrix(*(quats / np.linalg.norm(quats, axis=1, keepdims=True)).T) * scales[rows, None, :]
        noise = edit.random().standard_normal((len(rows), 3))
        offset = edit.evaluate(self.jitter) * np.einsum("nij,nj->ni", axes, noise)
        edit.choose(is_copied, copies=3, old_rows=1)
        edit.set_children("means", rows, np.stack([means[rows], means[rows], means[rows] + offset], axis=1))


def grid_cells(means: Floats, cells: int) -> NDArray[np.int64]:
    """Return the index of the grid cell of each mean, [N], or -1 outside the grid."""
    is_finite = np.isfinite(means).all(axis=1)
    if not is_finite.any():
        return np.full(len(means), -1)
    low, high = np.quantile(means[is_finite], GRID_QUANTILES, axis=0)
    is_inside = is_finite & np.all((means >= low) & (means <= high), axis=1)
    position = (np.where(is_inside[:, None], means, low) - low) / np.maximum(high - low, 1e-30) * cells
    index = np.minimum(position.astype(np.int64), cells - 1)
    return np.where(is_inside, np.ravel_multi_index(tuple(index.T), (cells,) * 3), -1)
