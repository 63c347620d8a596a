"""Importance by blend weights, view by view (Mini-Splatting, Fang and Wang 2024)."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.control import Weights, largest_of, weights
from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import WEIGHT, Survey
from clsplat.density.thresholds import Share


def drawn_weights(survey: Survey, of_view: float | None = None, drawn: int | None = None) -> Weights:
    """Return the weights in training views.  drawn: the number of views; None: all; of_view: as in `weights`."""
    views = survey.views if drawn is None else survey.drawn(drawn)
    return weights(survey.looks(views), survey.count, of_view)


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
    grows: ClassVar[bool] = False
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
        found = edit.survey.once(drawn_weights, self.of_view, self.views)
        kept = largest_of(found.total, self.of_all) & (found.views >= self.views_below)
        edit.choose(~kept, copies=0, kept=0)
