"""Score the contributions of Gaussians to images, and select Gaussians with high scores or sample them by score."""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import SQUARE, WEIGHT, RenderedView
from clsplat.density.thresholds import UnitInterval
from clsplat.formats.splats import inverse_opacities

Score = Literal["weight", "sensitivity"]
ScoreFunction = Callable[[Iterable[RenderedView], int], NDArray[np.float32]]


@dataclass(frozen=True)
class Weights:
    """The weight of each Gaussian in some views."""

    total: NDArray[Any]  # [N] blend weight, alpha T, summed over all pixels and views
    views: NDArray[np.int64]  # [N] number of views in which the Gaussian is useful; 0 if they were not counted


def weights(
    views: Iterable[RenderedView], count: int, weight_per_view: float | None = None, dtype: DTypeLike = np.float64
) -> Weights:
    """Return the weights of N = `count` Gaussians, summed over views in their order.

    weight_per_view: the Gaussians with the largest weights in a view, which together have this fraction of its total
    weight, are useful in the view; None: do not count views.  dtype: data type of `total`.
    """
    total, useful_views = np.zeros(count, dtype), np.zeros(count, np.int64)
    for view in views:
        weight = view.sum(WEIGHT)
        total += weight
        if weight_per_view is not None:
            useful_views += select_by_weight(weight.astype(np.float64), weight_per_view)
    return Weights(total, useful_views)


def select_by_weight(weight: NDArray[np.float64], fraction: float) -> NDArray[np.bool_]:
    """Return the mask, [N], of the heaviest Gaussians that together have at least `fraction` of the total weight.

    Gaussians of weight 0 are not selected.
    """
    order = np.argsort(-weight, kind="stable")
    preceding_sum = np.cumsum(weight[order]) - weight[order]  # sum of all larger weights
    mask = np.zeros(len(weight), bool)
    mask[order] = (preceding_sum < fraction * weight.sum()) & (weight[order] > 0)
    return mask


def contributions(views: Iterable[RenderedView], count: int) -> NDArray[np.float32]:
    """Return the blend weights, alpha T, summed over pixels and views, [N], in single precision."""
    return weights(views, count, dtype=np.float32).total


def sensitivities(views: Iterable[RenderedView], count: int) -> NDArray[np.float32]:
    """Return the squares of dI/dG summed over pixels, channels, and views, [N] (Speedy-Splat, Hanson et al. 2025).

    I is an image value and G the value of the Gaussian at that pixel; alpha is the opacity times G.
    """
    total = np.zeros(count, np.float32)
    for view in views:
        for channel in range(3):
            total += view.sum(SQUARE, channel=channel)
    return total


SCORES: dict[Score, ScoreFunction] = {"weight": contributions, "sensitivity": sensitivities}


Mask = NDArray[np.bool_]


def sampling_order(candidates: Mask, weights: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of the candidates in the order of weighted sampling without replacement.

    candidates: mask, [N].  weights: [N], 0 to infinity.  The largest ln(U) / weight comes first (Efraimidis and
    Spirakis 2006).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        keys = np.log1p(-rng.random(len(weights))) / weights
    indices = np.flatnonzero(candidates)
    return indices[np.argsort(-keys[indices], kind="stable")]


def select_largest(score: NDArray[np.floating], limit: int, candidates: Mask | None = None) -> Mask:
    """Return the mask, [N], of the `limit` candidates with the largest scores; ties go to the lower index.

    candidates: mask, [N]; None for all.
    """
    indices = np.arange(len(score)) if candidates is None else np.flatnonzero(candidates)
    order = np.argsort(-score[indices], kind="stable")
    mask = np.zeros(len(score), bool)
    mask[indices[order[:limit]]] = True
    return mask


class SampledPruning(Rule):
    """Base class of rules that remove a random sample of the faint and the large Gaussians."""

    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share", "opacity_below", "size_above"})

    share: UnitInterval = 0.5
    """Fraction of the faint and the large Gaussians to remove."""
    opacity_below: Positive = 0.005
    """Opacity below which a Gaussian is faint; may be scheduled."""
    size_above: Positive = 0.1
    """Size above which a Gaussian is large: largest standard deviation relative to the extent; may be scheduled."""

    @abstractmethod
    def weights(self, edit: Edit) -> NDArray[np.float64]:
        """Return the sampling weight for the removal of each Gaussian, [N], from 0 to infinity."""

    def mark(self, edit: Edit) -> None:
        """Mark a sample of Gaussians for removal.  The size of a split Gaussian is that of its children."""
        gaussians = edit.gaussians
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        size = np.exp(gaussians.get("log_scales").max(axis=1)) * edit.shrink.get()
        is_large = size > edit.evaluate(self.size_above) * edit.scene_scale.extent
        candidates = ((opacity < edit.evaluate(self.opacity_below)) | is_large) & (edit.row_counts() > 0)
        order = sampling_order(candidates, self.weights(edit), edit.random())
        mask = np.zeros_like(candidates)
        mask[order[: int(self.share * len(order))]] = True
        edit.choose(mask, copies=0, old_rows=0)
