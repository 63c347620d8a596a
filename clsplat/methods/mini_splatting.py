"""Prune and hide Gaussians by their blend weights in each view.

From Mini-Splatting and Mini-Splatting2 (Fang and Wang 2024).
"""

import logging
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import Weights, select_by_weight, weights
from clsplat.density.survey import WEIGHT, Survey
from clsplat.density.thresholds import UnitInterval
from clsplat.gaussians.gaussians import HIDDEN, HIDDEN_VIEWS, hide
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.float64]


def sampled_weights(survey: Survey, weight_per_view: float | None = None, number: int | None = None) -> Weights:
    """Return the blend weights of all Gaussians in training views.

    weight_per_view: see `weights`.  number: number of views to sample; None for all views.
    """
    views = survey.views if number is None else survey.sample_views(number)
    return weights(survey.render(views), survey.count, weight_per_view)


def find_useless(survey: Survey, weight_per_view: float) -> NDArray[np.bool_]:
    """Return a mask, [V, N], of the Gaussians that are visible but not useful in each view.

    A view's useful Gaussians are those with the largest weights, up to `weight_per_view` of the view's total weight.
    """
    is_useless = np.zeros((len(survey.views), survey.count), bool)
    for row, render in zip(is_useless, survey.render(survey.views), strict=True):
        row[:] = (render.radius() > 0) & ~select_by_weight(render.sum(WEIGHT).astype(np.float64), weight_per_view)
    return is_useless


class PruneUseless(Rule):
    """Remove Gaussians that are useful in few training views, and the Gaussians with the smallest weights.

    The weight of a Gaussian in a view is the sum of alpha T over its pixels.  A view's useful Gaussians are those
    with the largest weights, up to `weight_per_view` of the view's total weight.
    """

    type: Literal["prune_useless"] = "prune_useless"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view", "weight_total", "views", "views_below"})

    weight_per_view: UnitInterval = 0.99
    """Fraction of a view's weight that its useful Gaussians make up."""
    views: Annotated[int, Field(ge=1)] | None = None
    """Number of training views, sampled at random by seed and step; default: all."""
    views_below: Annotated[int, Field(ge=0)] = 2
    """Gaussians that are useful in fewer views are removed."""
    weight_total: UnitInterval = 0.999
    """Fraction of the weight in all views that is kept; the smallest weights are removed."""

    def mark(self, edit: Edit) -> None:
        weights = edit.survey.compute_once(sampled_weights, self.weight_per_view, self.views)
        is_useful = select_by_weight(weights.total, self.weight_total) & (weights.views >= self.views_below)
        edit.choose(~is_useful, copies=0, old_rows=0)


class HideUseless(Scheduled):
    """Save time in a training step by skipping the Gaussians that contribute little to its training view
    (Mini-Splatting2, Fang and Wang 2024).

    The Gaussians with the largest weights, alpha T summed over pixels, stay visible, up to `weight_per_view` of the
    view's total weight.  New Gaussians are hidden in the same views as their source.  Other renders, and all renders
    after the training, show every Gaussian.
    """

    stage: Literal["hide_useless"] = "hide_useless"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view"})
    edits: ClassVar[bool] = True

    weight_per_view: UnitInterval = 0.99
    """Fraction of a view's weight that its visible Gaussians make up."""

    def attach(self, run: Run) -> None:
        if HIDDEN not in run.model.gaussians.tables:
            run.model.gaussians.add(HIDDEN, -(-len(run.scene.split("train")) // HIDDEN_VIEWS))

    def run(self, run: Run) -> None:
        hide(run.model.gaussians, find_useless(run.survey(), self.weight_per_view))
