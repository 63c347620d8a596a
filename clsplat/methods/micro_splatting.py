"""Split, prune, and merge Gaussians as in Micro-splatting (Lee et al. 2025).

All rules select Gaussians on the host, where NumPy can compare them with each other.
"""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative, Positive, explain_schedule
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import select_largest
from clsplat.density.statistics import SEEN, Statistic, StatisticName
from clsplat.density.thresholds import PixelQuantile, Quantile, Threshold, UnitInterval
from clsplat.formats.splats import SH_C0, inverse_opacities
from clsplat.gaussians.gaussians import INTERVAL2, Gaussians
from clsplat.gaussians.mixture import masses, merge
from clsplat.losses.base import ViewGradients
from clsplat.opencl.device import Array
from clsplat.photos.photographs import unmasked_gradient
from clsplat.render.filters import AT_REST

CHILD_COVARIANCE = 0.5  # Lee et al. 2025: a child's covariance is half its parent's


class RenderedTexture(Statistic):
    """Gradient magnitude of the rendered image at the projected mean, px⁻¹ (Micro-splatting, Lee et al. 2025)."""

    type: Literal["rendered_texture"] = "rendered_texture"

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        frame, comparison = gradients.frame, gradients.comparison
        gaussians.device.program("texture.cl").sample_magnitude(
            items=gaussians.count,
            magnitude=unmasked_gradient(comparison.workspace, frame.camera, frame.image, comparison.mask),
            splats=frame.splats,
            radius=frame.radius,
            total=total,
            width=frame.camera.width,
            height=frame.camera.height,
            stride=frame.camera.stride,
            count=gaussians.count,
        )


class Subdivide(Rule):
    """Base class of rules that replace a limited fraction of the Gaussians with smaller ones."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"children", "beta", "max_fraction", "radius_above"})

    children: Annotated[int, Field(ge=2, le=8)] = 2
    """Number of Gaussians that replace one."""
    beta: Annotated[float, Field(gt=0, le=1)] = CHILD_COVARIANCE
    """A child's covariance divided by its parent's."""
    max_fraction: UnitInterval = 0.05
    """Largest fraction of all Gaussians that one edit splits, starting with the largest scores."""
    radius_above: Annotated[float, Field(ge=0)] = 2.0
    """Smallest mean radius on the screen at which a Gaussian is split: three standard deviations, px."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_radius"}

    def subdivide(self, edit: Edit, candidates: NDArray[np.bool_], score: NDArray[np.float32]) -> None:
        """Split the candidates, [N], with the largest scores.

        Skips Gaussians that are small on the screen or that an earlier rule has selected.
        """
        candidates = candidates & (edit.row_counts() == 1) & (edit.stats.mean("screen_radius") >= self.radius_above)
        is_split = select_largest(score, int(self.max_fraction * len(candidates)), candidates)
        edit.choose(is_split, copies=self.children, old_rows=0, shrink=self.beta**0.5)


class SplitTextured(Subdivide):
    """Split Gaussians where the photographs are textured.

    With `gradient_above: 0`, only the texture decides.  Otherwise, the mean of `screen_grad` must also reach that
    value; choose a threshold below those of the other rules.
    """

    type: Literal["split_textured"] = "split_textured"
    training_keys: ClassVar[frozenset[str]] = frozenset({"texture_above", "gradient_above"})

    texture: StatisticName = "texture"
    """Statistic whose mean is the texture."""
    texture_above: Threshold = PixelQuantile(quantile=0.8, of="pixels")
    """Smallest texture at which a Gaussian is split: a number, or a quantile."""
    gradient_above: NonNegative = 1.0e-4
    """Smallest mean of `screen_grad` at which a Gaussian is split."""

    @property
    def statistics(self) -> set[str]:
        return {*super().statistics, self.texture, "screen_grad"}

    def mark(self, edit: Edit) -> None:
        texture, gradient = edit.stats.mean(self.texture), edit.stats.mean("screen_grad")
        threshold = edit.threshold(self.texture, self.texture_above)
        is_visible = edit.gaussians.get(SEEN)[:, 0] > 0
        candidates = is_visible & (texture >= threshold) & (gradient >= edit.evaluate(self.gradient_above))
        self.subdivide(edit, candidates, texture)


class SplitOversized(Subdivide):
    """Split Gaussians whose covariance trace is larger than τ = 3 s².

    s is `rms_above`, as a fraction of the scene extent or a quantile of the RMS scales.  With `pixels`, s is the
    length of that many pixels in the nearest training view.
    """

    type: Literal["split_oversized"] = "split_oversized"
    training_keys: ClassVar[frozenset[str]] = frozenset({"rms_above"})

    rms_above: Annotated[Quantile | Positive, explain_schedule(", or {quantile}")] = 0.01
    """RMS scale above which a Gaussian is split, as a fraction of the scene extent or a quantile of all RMS scales."""
    pixels: Annotated[float, Field(gt=0)] | None = None
    """RMS scale above which a Gaussian is split, px in the nearest training view; replaces `rms_above`."""

    @property
    def tables(self) -> set[str]:
        return {INTERVAL2} if self.pixels else set()

    def active_conflicts(self) -> Mapping[str, str]:
        return {**super().active_conflicts(), **(AT_REST if self.pixels else {})}

    def mark(self, edit: Edit) -> None:
        rms = np.sqrt(np.exp(2 * edit.gaussians.get("log_scales")).mean(axis=1))
        if self.pixels:
            bound = self.pixels * np.sqrt(edit.gaussians.get(INTERVAL2)[:, 0])
        elif isinstance(self.rms_above, Quantile):
            bound = np.full_like(rms, np.quantile(rms, self.rms_above.quantile) if len(rms) else 0.0)
        else:
            bound = np.full_like(rms, edit.evaluate(self.rms_above) * edit.scene_scale.extent)
        self.subdivide(edit, rms > bound, rms / np.maximum(bound, 1e-30))


# Rules that reduce the number of Gaussians: the refinement in the second version of Micro-splatting.

Floats = NDArray[np.float64]


class PruneUnimportant(Rule):
    """Remove the fraction of Gaussians with the smallest product of opacity and geometric mean scale."""

    type: Literal["prune_unimportant"] = "prune_unimportant"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share"})

    share: UnitInterval = 0.05
    """Fraction of all Gaussians to remove."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        score = opacity * np.exp(gaussians.get("log_scales").astype(np.float64).mean(axis=1))
        is_pruned = np.zeros(len(score), bool)
        is_pruned[np.argsort(score, kind="stable")[: int(self.share * len(score))]] = True
        edit.choose(is_pruned, copies=0, old_rows=0)


class MergeNeighbors(Rule):
    """Merge two mutual nearest neighbors that are close and similar in color into one Gaussian.

    The result has the mean, covariance, and color of their mixture, weighted by opacity times volume, and the opacity
    that preserves the sum of these weights.  It replaces the heavier Gaussian and keeps its statistics and Adam
    moments, except the moments of scales and rotation.
    """

    type: Literal["merge_neighbors"] = "merge_neighbors"
    grows: ClassVar[bool] = False
    conflicts = AT_REST
    training_keys: ClassVar[frozenset[str]] = frozenset({"distance_below", "color_below"})

    distance_below: Positive = 0.5
    """Distance below which two Gaussians are merged, as a fraction of the sum of their mean scales."""
    color_below: Positive = 0.05
    """Difference of base colors below which two Gaussians are merged: maximum over channels, in [0, 1]."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        names = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
        tables = {name: gaussians.get(name).astype(np.float64) for name in names}
        first, second = self._pairs(edit, tables)
        is_unchanged = edit.row_counts() == 1
        is_usable = is_unchanged[first] & is_unchanged[second]
        first, second = first[is_usable], second[is_usable]
        if not len(first):
            return
        for name, values in merge(tables, first, second).items():
            edit.set_rows(name, first, values)
        edit.zero_moments(first, ("log_scales", "quats"))  # the axes have changed
        is_absorbed = np.zeros(gaussians.count, bool)
        is_absorbed[second] = True
        edit.choose(is_absorbed, copies=0, old_rows=0)

    def _pairs(self, edit: Edit, tables: dict[str, Floats]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows of mutual nearest neighbors to merge, the heavier one of each pair first."""
        means, mass = tables["means"], masses(tables)
        if len(means) < 2 or not np.isfinite(means).all():  # training stops at its next report
            return np.empty(0, np.int64), np.empty(0, np.int64)
        rows = np.arange(len(means))
        distances, neighbors = scipy.spatial.cKDTree(means).query(means, k=2)
        column = np.where(neighbors[:, 0] == rows, 1, 0)  # with equal means, a row may be its own second neighbor
        distance, nearest = distances[rows, column], neighbors[rows, column]
        is_mutual = (nearest[nearest] == rows) & (rows < nearest)
        size = np.exp(tables["log_scales"].mean(axis=1))
        is_close = distance < edit.evaluate(self.distance_below) * (size + size[nearest])
        color = SH_C0 * np.abs(tables["sh_base"] - tables["sh_base"][nearest]).max(axis=1)
        first = rows[is_mutual & is_close & (color < edit.evaluate(self.color_below))]
        second = nearest[first]
        is_heavier = mass[first] >= mass[second]
        return np.where(is_heavier, first, second), np.where(is_heavier, second, first)
