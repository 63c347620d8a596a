"""Grow and prune by the wrong pixels that each Gaussian contributes to, as in FastGS (Ren et al. 2025)."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import SampledPruning
from clsplat.density.survey import BLENDED, LOSSES, Survey, normalize
from clsplat.density.thresholds import UnitInterval

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WrongPixels:
    """The wrong pixels that each Gaussian contributes to."""

    pixels: NDArray[np.int64]  # [N] mean number per view, rounded down
    score: Floats  # [N] number per view times the view's loss, summed over views, scaled to [0, 1]


def count_wrong_pixels(survey: Survey, views: int, error_above: float) -> WrongPixels:
    """Count the wrong pixels that each Gaussian contributes to, over `views` training views."""
    sampled_views = survey.sample_views(views)
    total, weighted_sum = np.zeros(survey.count, np.int64), np.zeros(survey.count)
    for render in survey.render(sampled_views):
        error, is_unmasked = render.error().astype(np.float64), render.counted_pixels()
        is_wrong = is_unmasked & (normalize(error, is_unmasked) > error_above)
        pixels = render.sum(BLENDED, is_wrong).astype(np.int64)  # integers below 2^24: exact in float32
        total += pixels
        weighted_sum += render.loss(LOSSES) * pixels
    return WrongPixels(total // max(len(sampled_views), 1), normalize(weighted_sum, np.ones(len(weighted_sum), bool)))


class WrongPixelsRule(Rule):
    """Base class of rules that count wrong pixels; rules with the same `views` and `error_above` share the counts."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"views", "error_above"})

    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views, sampled at random by seed and step; all if there are fewer."""
    error_above: UnitInterval = 0.1
    """Error above which a pixel is wrong: mean over channels, scaled to [0, 1] in each view."""

    def count_wrong_pixels(self, edit: Edit) -> WrongPixels:
        """Return the counts of wrong pixels for the Gaussians before the edit."""
        return edit.survey.compute_once(count_wrong_pixels, self.views, self.error_above)


class RevertGrowth(WrongPixelsRule):
    """Undo the growth of Gaussians that contribute to few wrong pixels."""

    type: Literal["revert_growth"] = "revert_growth"
    training_keys: ClassVar[frozenset[str]] = frozenset({"pixels_above"})

    pixels_above: NonNegative = 5
    """Mean number of wrong pixels per view, rounded down, above which a Gaussian may grow."""

    def mark(self, edit: Edit) -> None:
        edit.undo_growth(self.count_wrong_pixels(edit).pixels <= edit.evaluate(self.pixels_above))


class PruneSampled(SampledPruning, WrongPixelsRule):
    """Remove a fraction of the faint and of the large Gaussians, sampled with weights 1 / (1 - score).

    The score is the number of wrong pixels times the loss of the view, summed over views and scaled to [0, 1].
    """

    type: Literal["prune_sampled"] = "prune_sampled"

    def weights(self, edit: Edit) -> Floats:
        with np.errstate(divide="ignore"):
            return np.asarray(1 / (1 - self.count_wrong_pixels(edit).score))


class PruneInaccurate(WrongPixelsRule):
    """Remove Gaussians with a large score, as defined for `prune_sampled`."""

    type: Literal["prune_inaccurate"] = "prune_inaccurate"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"score_above"})

    score_above: UnitInterval = 0.9
    """Score above which a Gaussian is removed."""

    def mark(self, edit: Edit) -> None:
        edit.choose(self.count_wrong_pixels(edit).score > self.score_above, copies=0, old_rows=0)
