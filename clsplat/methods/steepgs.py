"""Splitting where it lowers the loss at once: where the splitting matrix has a negative eigenvalue (SteepGS, Wang et
al. 2025).

Where a Gaussian's weight in the pixels is replaced by the mean of two, moved by ±ε v, the loss changes by
ε²/2 vᵀ S v + O(ε⁴).  Two Gaussians of a share of its opacity are such a mean up to the product of their alphas.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative, Positive, Schedule
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import largest
from clsplat.density.mixture import covariance_of
from clsplat.density.statistics import NEEDS_CONIC, Statistic
from clsplat.gaussians.gaussians import Gaussians
from clsplat.losses.base import ViewGradients
from clsplat.opencl.device import Array

Floats = NDArray[np.float64]
UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # places of a symmetric matrix in the six columns


class Splitting(Statistic):
    """The splitting matrix, Σ ∂L/∂alpha ∇²alpha over pixels, by the mean: xx, xy, xz, yy, yz, zz in scene units⁻²."""

    type: Literal["splitting"] = "splitting"
    components = 6
    conflicts = NEEDS_CONIC

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("saddle.cl").accumulate_splitting(
            items=gaussians.count,
            means=view.frame.drawn.gaussians["means"],
            splats=view.frame.splats,
            pixel_sums=view.pixel_sums,
            camera=view.frame.camera.array,
            total=total,
            stride=gaussians.capacity,
            count=gaussians.count,
        )


class SplitSteepest(Rule):
    """Replace a Gaussian by two, moved apart in the direction in which that lowers the loss most.

    It is split where the least eigenvalue of its splitting matrix, the mean over views, is low enough; the children
    move along its eigenvector.  Those with the lowest eigenvalues come first below the limit of the edit
    (`max_gaussians`, `budget`, memory).
    """

    type: Literal["split_steepest"] = "split_steepest"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"eigenvalue_below", "gradient_above", "distance", "shrink", "opacity"}
    )

    eigenvalue_below: Schedule = -1.0e-6
    """Largest eigenvalue that splits, in extents⁻²; by step."""
    gradient_above: NonNegative = 2.0e-4
    """Lowest mean of `screen_grad`; by step.  Almost all matrices have a negative eigenvalue, so that 0 splits most."""
    distance: Positive = 0.5
    """Way of each child, in standard deviations of the Gaussian in that direction; by step."""
    shrink: Annotated[float, Field(ge=1)] = 1.6
    """Divisor of the children's scales."""
    opacity: Literal["halved", "shared"] = "halved"
    """`halved`: the sum stays; `shared`: both together are as opaque as it was, 1 − √(1 − o) each."""

    @property
    def statistics(self) -> set[str]:
        return {"splitting", "screen_grad"}

    def mark(self, edit: Edit) -> None:
        gaussians, extent = edit.gaussians, edit.scene_scale.extent
        steep = edit.stats.mean("screen_grad") >= edit.at(self.gradient_above)
        rows = np.flatnonzero(steep & (edit.rows() == 1))
        least, axes = least_axes(edit.stats.means("splitting")[rows].astype(np.float64) * extent**2)
        room = len(rows) if edit.room is None else max(edit.room, 0)
        lowest = largest(-least, room, least < edit.at(self.eigenvalue_below))
        rows, axes = rows[lowest], axes[lowest]
        tables = {
            name: gaussians.get(name)[rows].astype(np.float64)
            for name in ("means", "quats", "log_scales", "logit_opacity")
        }
        covariance = covariance_of(tables["quats"], tables["log_scales"])
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", axes, covariance, axes))
        way = edit.at(self.distance) * deviation[:, None] * axes
        chosen = np.zeros(gaussians.count, bool)
        chosen[rows] = True
        edit.choose(chosen, copies=2, kept=0, shrink=1 / self.shrink)
        edit.set_children("means", rows, np.stack([tables["means"] + way, tables["means"] - way], axis=1))
        logits = divided_logits(tables["logit_opacity"], self.opacity)
        edit.set_children("logit_opacity", rows, np.stack([logits, logits], axis=1))


def least_axes(columns: Floats) -> tuple[Floats, Floats]:
    """Return the least eigenvalue of symmetric matrices, [N], and its unit eigenvector, [N, 3], from six columns.

    The component that is largest in size is positive.  Where a column is not finite, the eigenvalue is 0.
    """
    finite = np.isfinite(columns).all(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.where(finite, columns, 0)[:, UPPER])
    axes = vectors[:, :, 0]
    longest = np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1)
    return values[:, 0], axes * np.where(longest < 0, -1, 1)


def divided_logits(logits: Floats, opacity: Literal["halved", "shared"]) -> Floats:
    """Return the logits of the opacities of each of two, from that of the one, without overflow."""
    if opacity == "halved":  # o/2 = 1 / (2 + 2 e^-l) has the logit -log(1 + 2 e^-l)
        return np.asarray(-np.logaddexp(0, np.log(2) - logits))
    rest = np.logaddexp(0, logits) / 2  # -log of the transmittance of each
    return np.asarray(rest + np.log(-np.expm1(-rest)))
