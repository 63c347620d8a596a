"""Choices of Gaussians: the largest scores, draws without replacement, the removal of some that are faint or large."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clsplat.density.edit import Edit, Rule
from clsplat.density.thresholds import Share
from clsplat.formats.splats import inverse_opacities
from clsplat.schedule import Positive

Mask = NDArray[np.bool_]


def drawn_order(candidates: Mask, weights: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.intp]:
    """Return the candidates, [N], as they are drawn one after another by their weights, 0 to infinity (Efraimidis and
    Spirakis 2006: by ln(U) / weight, the largest first)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        keys = np.log1p(-random.random(len(weights))) / weights
    places = np.flatnonzero(candidates)
    return places[np.argsort(-keys[places], kind="stable")]


def largest(candidates: Mask, score: NDArray[np.floating], limit: int) -> Mask:
    """Return which candidates, [N], have the largest scores: at most `limit` of them, ties by index."""
    places = np.flatnonzero(candidates)
    order = np.argsort(-score[places], kind="stable")
    chosen = np.zeros_like(candidates)
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
        """Return the weights of the draw, [N], 0 to infinity."""

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
