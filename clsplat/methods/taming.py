"""Grow within a budget and prune by a score of each Gaussian, as in Taming 3DGS (Mallick et al. 2024)."""

from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.budget import Budget, BudgetContext
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import SampledPruning, sampling_order
from clsplat.density.survey import BLENDED, LOSSES, WEIGHT, RenderedView, Survey, normalize
from clsplat.formats.splats import inverse_opacities

Floats = NDArray[np.float64]


def normalize_by_median(values: NDArray[np.floating]) -> Floats:
    """Divide values by the median of the positive values; return zeros if none is positive."""
    positive = values[values > 0]
    return np.asarray(values / np.median(positive), np.float64) if len(positive) else np.zeros(len(values))


def pixel_weights(render: RenderedView) -> Floats:
    """Return a view's pixel errors plus its photograph's edges, each scaled to [0, 1], [height, width]."""
    is_unmasked = render.counted_pixels()
    edges = np.abs(scipy.ndimage.laplace(render.photograph.image().mean(axis=2), mode="nearest"))
    return normalize(render.error().astype(np.float64), is_unmasked) + normalize(edges, is_unmasked)


def view_scores(survey: Survey, views: int) -> tuple[Floats, Floats]:
    """Return two sums over sampled views for each Gaussian, [N]: the loss, and the loss times the Gaussian's terms.

    Only views in which the Gaussian is visible count.  The terms of a Gaussian are its depth, its radius, and three
    sums over the pixels where it is blended: `pixel_weights`, the number of pixels, and its blend weights.
    """
    losses, terms = np.zeros(survey.count), np.zeros(survey.count)
    sampled_views = survey.sample_views(views)
    for view, render in zip(sampled_views, survey.render(sampled_views), strict=True):
        radius = render.radius()
        row = view.world_to_camera[2]
        depth = (render.model.gaussians.get("means") * row[:3]).sum(axis=1) + row[3]  # BLAS sums depend on threads
        textures = pixel_weights(render), np.ones(render.counted_pixels().shape)
        sums = [render.sum(BLENDED, texture) for texture in textures]
        values = (5, depth), (10, radius), (10, sums[0]), (0.1, sums[1]), (50, render.sum(WEIGHT))
        loss = render.loss(LOSSES) * (radius > 0)
        losses += loss
        terms += loss * sum(factor * normalize_by_median(np.where(radius > 0, value, 0)) for factor, value in values)
    return losses, terms


class ScoredRule(Rule):
    """Base class of rules that sample Gaussians with weights from scores.  Rules with the same `views` share scores."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"views"})

    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views, sampled at random by seed and step; all if there are fewer."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_grad"}

    def score(self, edit: Edit) -> Floats:
        """Return the scores, [N], 0 or more."""
        gaussians, (losses, terms) = edit.gaussians, edit.survey.compute_once(view_scores, self.views)
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        volume = np.exp(gaussians.get("log_scales").astype(np.float64).sum(axis=1))
        values = (25, edit.stats.mean("screen_grad")), (100, opacity), (25, volume)
        score: Floats = terms + losses * sum(factor * normalize_by_median(value) for factor, value in values)
        return score


class GrowScored(ScoredRule):
    """Undo the part of earlier rules' growth that exceeds the limit of the edit (`max_gaussians`, `budget`, memory).

    Gaussians that may grow are sampled with their scores as weights.  Clones and splits share the limit in proportion
    to their numbers.
    """

    type: Literal["grow_scored"] = "grow_scored"

    def mark(self, edit: Edit) -> None:
        if edit.room is None or edit.room >= 0:
            return
        rows, is_clone = edit.row_counts().astype(np.int64), edit.old_rows.get() > 0
        is_undone = rows > 1
        if not is_undone.any():
            return
        room = edit.room + int(np.maximum(rows - 1, 0).sum())
        score, rng = self.score(edit), edit.random()
        # first the clones, with their part of the room, and then the splits, with the remainder
        for group, fraction in ((is_clone, (is_undone & is_clone).sum() / is_undone.sum()), (~is_clone, 1.0)):
            order = sampling_order((rows > 1) & group, score, rng)
            added_rows = np.cumsum(rows[order] - 1)
            is_affordable = added_rows <= round(fraction * room)
            is_undone[order[is_affordable]] = False
            room -= int(added_rows[is_affordable][-1]) if is_affordable.any() else 0
        edit.undo_growth(is_undone)


class PruneScored(SampledPruning, ScoredRule):
    """Remove a fraction of the faint and of the large Gaussians, sampled with weights 1 / score."""

    type: Literal["prune_scored"] = "prune_scored"

    def weights(self, edit: Edit) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(1 / self.score(edit))


class Parabola(Budget):
    """Grow to a given number, fast at first: P0 + (B - P0) (2x/S - x²/S²) after x of S edits (Taming 3DGS, Mallick et
    al. 2024).

    Each edit plans the remainder of the parabola from the current number, so that no P0 is needed and pruned Gaussians
    are replaced.
    """

    type: Literal["parabola"] = "parabola"
    training_keys: ClassVar[frozenset[str]] = frozenset({"gaussians"})

    gaussians: Annotated[int, Field(ge=1)]
    """The number B that the last edit may reach."""

    def limit(self, edit: Edit, context: BudgetContext, state: dict[str, float]) -> int:
        shortfall = self.gaussians - edit.gaussians.count
        remaining = (context.remaining_edits - 1) / context.remaining_edits
        return self.gaussians - int(shortfall * remaining**2) if shortfall > 0 else self.gaussians
