"""Importance by blend weights, view by view (Mini-Splatting, Fang and Wang 2024)."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import WEIGHT, Survey
from clsplat.density.thresholds import Share


@dataclass(frozen=True)
class Weights:
    """What each Gaussian is in the training views."""

    total: NDArray[np.float64]  # [N] blend weight, alpha T, summed over all pixels
    views: NDArray[np.int64]  # [N] in which it is useful


def weights(survey: Survey, of_view: float, drawn: int | None = None) -> Weights:
    """Return the weights, and the views in which a Gaussian is one of the largest that make `of_view` of the weight.

    drawn: the number of views; None: all.
    """
    total, views = np.zeros(survey.count), np.zeros(survey.count, np.int64)
    for look in survey.looks(survey.views if drawn is None else survey.drawn(drawn)):
        weight = look.sum(WEIGHT).astype(np.float64)
        total += weight
        views += largest_of(weight, of_view)
    return Weights(total, views)


def largest_of(weight: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Return the fewest Gaussians, [N], that make this share of the weight; those without weight are none of them."""
    order = np.argsort(-weight, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    found = np.zeros(len(weight), bool)
    found[order] = (before < share * weight.sum()) & (weight[order] > 0)
    return found


def useless(survey: Survey, of_view: float) -> NDArray[np.bool_]:
    """Return for each view, [V, N], which Gaussians it sees that are not of the largest that make `of_view` of its
    weight."""
    found = np.zeros((len(survey.views), survey.count), bool)
    for here, look in zip(found, survey.looks(survey.views), strict=True):
        here[:] = (look.radius() > 0) & ~largest_of(look.sum(WEIGHT).astype(np.float64), of_view)
    return found


class PruneUseless(Rule):
    """Remove Gaussians that are useful in few training views, and those that together have little weight.

    In a view those are useful that make most of its weight, alpha T over all pixels, the largest first.
    """

    type: Literal["prune_useless"] = "prune_useless"
    training_keys: ClassVar[frozenset[str]] = frozenset({"of_view", "of_all", "views", "views_below"})

    of_view: Share = 0.99
    """Share of a view's weight that is made by what is useful in it."""
    views: Annotated[int, Field(ge=1)] | None = None
    """Number of training views, drawn by seed and step; all of them without a number, or where there are no more."""
    views_below: Annotated[int, Field(ge=0)] = 2
    """Number of views below which a Gaussian is removed."""
    of_all: Share = 0.999
    """Share of the weight in all views that stays; the smallest weights go."""

    def mark(self, edit: Edit) -> None:
        found = edit.survey.once(weights, self.of_view, self.views)
        kept = largest_of(found.total, self.of_all) & (found.views >= self.views_below)
        edit.choose(~kept, copies=0, kept=0)
