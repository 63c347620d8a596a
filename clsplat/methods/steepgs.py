"""Split Gaussians where a split immediately lowers the loss, as in SteepGS (Wang et al. 2025).

This is the case if the splitting matrix S has a negative eigenvalue.  If a Gaussian's weight in the pixels is replaced
with the mean of two copies moved by ±ε v, the loss changes by ε²/2 vᵀ S v + O(ε⁴).  Two Gaussians, each with a
part of the opacity, form such a mean, up to the product of their alphas.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative, Positive, Schedule
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import select_largest
from clsplat.density.statistics import NEEDS_CONIC, Statistic
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.mixture import covariance_matrices
from clsplat.losses.base import ViewGradients
from clsplat.opencl.device import Array

Floats = NDArray[np.float64]
MATRIX_COLUMNS = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # column of each element of the symmetric matrix


class Splitting(Statistic):
    """The splitting matrix with respect to the mean, Σ ∂L/∂alpha ∇²alpha over pixels.

    Columns xx, xy, xz, yy, yz, zz, scene units⁻².
    """

    type: Literal["splitting"] = "splitting"
    components = 6
    conflicts = NEEDS_CONIC

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("saddle.cl").accumulate_splitting(
            items=gaussians.count,
            means=gradients.frame.model.gaussians["means"],
            splats=gradients.frame.splats,
            pixel_sums=gradients.pixel_sums,
            camera=gradients.frame.camera.array,
            total=total,
            stride=gaussians.capacity,
            count=gaussians.count,
        )


class SplitSteepest(Rule):
    """Replace a Gaussian with two, moved apart in the direction that lowers the loss most.

    A Gaussian is split if the smallest eigenvalue of its splitting matrix, averaged over views, is low enough; the
    children move along the eigenvector.  If the edit has a limit (`max_gaussians`, `budget`, memory), the lowest
    eigenvalues come first.
    """

    type: Literal["split_steepest"] = "split_steepest"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"eigenvalue_below", "gradient_above", "distance", "shrink", "opacity"}
    )

    eigenvalue_below: Schedule = -1.0e-6
    """Eigenvalue below which a Gaussian is split, extents⁻²."""
    gradient_above: NonNegative = 2.0e-4
    """Smallest mean of `screen_grad` at which a Gaussian is split.  Almost all matrices have a negative eigenvalue, so
    0 splits most Gaussians."""
    distance: Positive = 0.5
    """Offset of each child, in standard deviations of the Gaussian in that direction."""
    shrink: Annotated[float, Field(ge=1)] = 1.6
    """Divisor of the children's scales."""
    opacity: Literal["halved", "shared"] = "halved"
    """`halved`: each child has half the opacity; `shared`: both together are as opaque as their parent,
    1 − √(1 − o) each."""

    @property
    def statistics(self) -> set[str]:
        return {"splitting", "screen_grad"}

    def mark(self, edit: Edit) -> None:
        gaussians, extent = edit.gaussians, edit.scene_scale.extent
        has_gradient = edit.stats.mean("screen_grad") >= edit.evaluate(self.gradient_above)
        rows = np.flatnonzero(has_gradient & (edit.row_counts() == 1))
        values, axes = smallest_eigenvectors(edit.stats.means("splitting")[rows].astype(np.float64) * extent**2)
        room = len(rows) if edit.room is None else max(edit.room, 0)
        mask = select_largest(-values, room, values < edit.evaluate(self.eigenvalue_below))
        rows, axes = rows[mask], axes[mask]
        tables = {
            name: gaussians.get(name)[rows].astype(np.float64)
            for name in ("means", "quats", "log_scales", "logit_opacity")
        }
        covariance = covariance_matrices(tables["quats"], tables["log_scales"])
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", axes, covariance, axes))
        offset = edit.evaluate(self.distance) * deviation[:, None] * axes
        is_split = np.zeros(gaussians.count, bool)
        is_split[rows] = True
        edit.choose(is_split, copies=2, old_rows=0, shrink=1 / self.shrink)
        edit.set_children("means", rows, np.stack([tables["means"] + offset, tables["means"] - offset], axis=1))
        logits = divide_logits(tables["logit_opacity"], self.opacity)
        edit.set_children("logit_opacity", rows, np.stack([logits, logits], axis=1))


def smallest_eigenvectors(columns: Floats) -> tuple[Floats, Floats]:
    """Return the smallest eigenvalue of each symmetric matrix, [N], and its unit eigenvector, [N, 3].  columns: [N, 6].

    The component of the eigenvector with the largest magnitude is positive.  Rows that are not finite give 0.
    """
    is_finite = np.isfinite(columns).all(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.where(is_finite, columns, 0)[:, MATRIX_COLUMNS])
    axes = vectors[:, :, 0]
    dominant = np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1)
    return values[:, 0], axes * np.where(dominant < 0, -1, 1)


def divide_logits(logits: Floats, opacity: Literal["halved", "shared"]) -> Floats:
    """Return the logit of the opacity of each of two children, given their parent's, without overflow."""
    if opacity == "halved":  # o/2 = 1 / (2 + 2 e^-l) has the logit -log(1 + 2 e^-l)
        return np.asarray(-np.logaddexp(0, np.log(2) - logits))
    depth = np.logaddexp(0, logits) / 2  # optical depth of each: -log of its transmittance
    return np.asarray(depth + np.log(-np.expm1(-depth)))
