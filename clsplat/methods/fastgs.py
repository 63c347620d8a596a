"""Rules that ask in how many pixels of some training views a Gaussian takes part that are drawn wrongly (FastGS, Ren et
al. 2025)."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import SampledPruning
from clsplat.density.survey import BLENDED, LOSSES, Survey, normalize
from clsplat.density.thresholds import Share

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Wrong:
    """What each Gaussian has to do with wrong pixels."""

    pixels: NDArray[np.int64]  # [N] in a view, the mean rounded down
    score: Floats  # [N] their number times the loss of their view, summed; 0 for the least of all Gaussians, 1 the most


def wrong_pixels(survey: Survey, views: int, error_above: float) -> Wrong:
    """Count the wrong pixels in which each Gaussian is blended, over `views` training views."""
    drawn = survey.sample_views(views)
    total, weighted = np.zeros(survey.count, np.int64), np.zeros(survey.count)
    for look in survey.render(drawn):
        error, counted = look.error().astype(np.float64), look.counted()
        wrong = counted & (normalize(error, counted) > error_above)
        pixels = look.sum(BLENDED, wrong).astype(np.int64)  # whole numbers below 2^24: exact
        total += pixels
        weighted += look.loss(LOSSES) * pixels
    return Wrong(total // max(len(drawn), 1), normalize(weighted, np.ones(len(weighted), bool)))


class ByWrongPixels(Rule):
    """Base of rules that ask for wrong pixels; rules with the same `views` and `error_above` share the answer."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"views", "error_above"})

    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views, drawn by seed and step; all where there are no more."""
    error_above: Share = 0.1
    """Error of a wrong pixel: mean over the channels, 0 for the least of its view and 1 for the largest."""

    def wrong(self, edit: Edit) -> Wrong:
        """Return what is asked for, of the Gaussians before the edit."""
        return edit.survey.cached(wrong_pixels, self.views, self.error_above)


class RevertGrowth(ByWrongPixels):
    """Undo the growth, by the rules before this one, of Gaussians that take part in few wrong pixels."""

    type: Literal["revert_growth"] = "revert_growth"
    training_keys: ClassVar[frozenset[str]] = frozenset({"pixels_above"})

    pixels_above: NonNegative = 5
    """Wrong pixels in a view, the mean rounded down, above which a Gaussian grows; by step."""

    def mark(self, edit: Edit) -> None:
        edit.undo_growth(self.wrong(edit).pixels <= edit.at(self.pixels_above))


class PruneSampled(SampledPruning, ByWrongPixels):
    """Remove a share of the faint and the large Gaussians, drawn by 1 / (1 - score).

    The score is the number of wrong pixels times the loss of their view, summed over the views, and scaled to [0, 1].
    """

    type: Literal["prune_sampled"] = "prune_sampled"

    def weights(self, edit: Edit) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(1 / (1 - self.wrong(edit).score))


class PruneInaccurate(ByWrongPixels):
    """Remove Gaussians with a large score, that of `prune_sampled`."""

    type: Literal["prune_inaccurate"] = "prune_inaccurate"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"score_above"})

    score_above: Share = 0.9
    """Score above which a Gaussian is removed."""

    def mark(self, edit: Edit) -> None:
        edit.choose(self.wrong(edit).score > self.score_above, copies=0, kept=0)
