"""What Gaussians do to the pictures, over pixels and views, and choices by it: the largest, draws, pruning."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import SQUARE, WEIGHT, SurveyView
from clsplat.density.thresholds import Share
from clsplat.formats.splats import inverse_opacities

Score = Literal["weight", "sensitivity"]
Scoring = Callable[[Iterable[SurveyView], int], NDArray[np.float32]]


@dataclass(frozen=True)
class Weights:
    """What each Gaussian is in some views."""

    total: NDArray[Any]  # [N] blend weight, alpha T, summed over all pixels; 0 where it is seen nowhere
    views: NDArray[np.int64]  # [N] in which it is useful; 0 where that was not asked for


def weights(
    looks: Iterable[SurveyView], count: int, weight_per_view: float | None = None, dtype: DTypeLike = np.float64
) -> Weights:
    """Return the weights of N = `count` Gaussians, added in the order of the views.

    weight_per_view: the share of a view's weight that its useful Gaussians, the heaviest first, add up to; None: do
    not count views.  dtype: of the total.
    """
    total, views = np.zeros(count, dtype), np.zeros(count, np.int64)
    for look in looks:
        weight = look.sum(WEIGHT)
        total += weight
        if weight_per_view is not None:
            views += largest_of(weight.astype(np.float64), weight_per_view)
    return Weights(total, views)


def largest_of(weight: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Return the fewest Gaussians, [N], that make this share of the weight; those without weight are none of them."""
    order = np.argsort(-weight, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    found = np.zeros(len(weight), bool)
    found[order] = (before < share * weight.sum()) & (weight[order] > 0)
    return found


def contributions(looks: Iterable[SurveyView], count: int) -> NDArray[np.float32]:
    """Return the blend weights, alpha T, summed over pixels and views, [N]; single precision decides near ties."""
    return weights(looks, count, dtype=np.float32).total


def sensitivities(looks: Iterable[SurveyView], count: int) -> NDArray[np.float32]:
    """Return the squares of dI/dG summed over views and channels, [N]: I is a value of the image, G that of the
    Gaussian there, whose alpha is opacity times G (Speedy-Splat, Hanson et al. 2025).
    """
    total = np.zeros(count, np.float32)
    for look in looks:
        for channel in range(3):
            total += look.sum(SQUARE, channel=channel)
    return total


SCORES: dict[Score, Scoring] = {"weight": contributions, "sensitivity": sensitivities}


# Choices of Gaussians: the largest scores, draws without replacement, the removal of some that are faint or large.

Mask = NDArray[np.bool_]


def drawn_order(candidates: Mask, odds: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.intp]:
    """Return the candidates, [N], as they are drawn one after another by their odds, 0 to infinity (Efraimidis and
    Spirakis 2006: by ln(U) / odds, the largest first)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        keys = np.log1p(-random.random(len(odds))) / odds
    places = np.flatnonzero(candidates)
    return places[np.argsort(-keys[places], kind="stable")]


def largest(score: NDArray[np.floating], limit: int, candidates: Mask | None = None) -> Mask:
    """Return which candidates, [N], have the largest scores: at most `limit` of them, ties by index; None: all are."""
    places = np.arange(len(score)) if candidates is None else np.flatnonzero(candidates)
    order = np.argsort(-score[places], kind="stable")
    chosen = np.zeros(len(score), bool)
    chosen[places[order[:limit]]] = True
    return chosen


class SampledPruning(Rule):
    """Base of rules that remove a share of the faint and the large Gaussians, which is drawn."""

    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share", "opacity_below", "size_above"})

    share: Share = 0.5
    """Share of the faint and large ones that is removed."""
    opacity_below: Positive = 0.005
    """Opacity of faint Gaussians; by step."""
    size_above: Positive = 0.1
    """Size of large Gaussians, largest standard deviation as a share of the extent; by step."""

    @abstractmethod
    def weights(self, edit: Edit) -> NDArray[np.float64]:
        """Return the odds of the draw, [N], 0 to infinity."""

    def mark(self, edit: Edit) -> None:
        """Sizes are those of the children after a split."""
        gaussians = edit.gaussians
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        size = np.exp(gaussians.get("log_scales").max(axis=1)) * edit.shrink.get()
        large = size > edit.at(self.size_above) * edit.scene_scale.extent
        candidates = ((opacity < edit.at(self.opacity_below)) | large) & (edit.rows() > 0)
        order = drawn_order(candidates, self.weights(edit), edit.random())
        chosen = np.zeros_like(candidates)
        chosen[order[: int(self.share * len(order))]] = True
        edit.choose(chosen, copies=0, kept=0)
