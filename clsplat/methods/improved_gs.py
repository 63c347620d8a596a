"""Split along the longest axis by an edge-aware score, and prune faint Gaussians (Improved-GS, Deng et al. 2025).

The third part of the method, several views per update, is `optimize.views_per_update`.
"""

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.quaternions import rotation_matrix
from clsplat.core.schedule import Positive
from clsplat.density.budget import Budget, BudgetContext
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import sampling_order, select_largest
from clsplat.density.statistics import TEXTURE
from clsplat.density.survey import RenderedView, Survey, normalize
from clsplat.density.thresholds import UnitInterval

Floats = NDArray[np.float64]


def edge_map(render: RenderedView) -> Floats:
    """Return the magnitude of the gradient of the photograph's luminance (Sobel), from 0 to 1, [height, width]."""
    gray = render.photograph.image().mean(axis=2, dtype=np.float64)
    edges = np.hypot(*(scipy.ndimage.sobel(gray, axis, mode="nearest") for axis in (0, 1)))
    return normalize(edges, render.counted_pixels())


def edge_scores(survey: Survey, views: int) -> Floats:
    """Return each Gaussian's blend weight times the photograph's edges, summed over pixels and views, [N]."""
    sampled_views, total = survey.sample_views(views), np.zeros(survey.count)
    for render in survey.render(sampled_views):
        total += render.sum(TEXTURE, edge_map(render))
    return total


class SplitLongAxis(Rule):
    """Replace a Gaussian with two Gaussians along its longest axis.

    If the edit has a limit (`max_gaussians`, `budget`, memory), Gaussians are sampled with their edge-aware
    scores as weights.
    """

    type: Literal["split_long_axis"] = "split_long_axis"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"gradient_above", "views", "distance", "opacity", "long_axis", "other_axes"}
    )

    gradient_above: Positive = 3.0e-4
    """Smallest mean of `screen_grad_abs` at which a Gaussian is split."""
    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views for the score, sampled at random by seed and step; all if there are fewer."""
    distance: Positive = 1.35
    """Offset of each child, in standard deviations of the parent along its longest axis (published: 0.45 · 3)."""
    opacity: Annotated[float, Field(gt=0, le=1)] = 0.6
    """Opacity of each child, as a fraction of the parent's."""
    long_axis: Annotated[float, Field(gt=0, le=1)] = 0.55
    """Factor on the longest scale; with the default `distance`, the children end where the parent ends."""
    other_axes: Annotated[float, Field(gt=0, le=1)] = 0.85
    """Factor on the other scales."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_grad_abs"}

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        is_split = (edit.stats.mean("screen_grad_abs") >= edit.evaluate(self.gradient_above)) & (edit.row_counts() == 1)
        if edit.room is not None and edit.room < is_split.sum():
            order = sampling_order(is_split, edit.survey.compute_once(edge_scores, self.views), edit.random())
            is_split = np.isin(np.arange(gaussians.count), order[: max(edit.room, 0)])
        rows = np.flatnonzero(is_split)
        means, quats, log_scales, logits = (
            gaussians.get(name)[rows].astype(np.float64) for name in ("means", "quats", "log_scales", "logit_opacity")
        )
        longest = log_scales.argmax(axis=1)
        index = np.arange(len(rows)), longest
        axes = rotation_matrix(*(quats / np.linalg.norm(quats, axis=1, keepdims=True)).T)[index[0], :, longest]
        offset = edit.evaluate(self.distance) * np.exp(log_scales[index])[:, None] * axes
        log_scales += math.log(self.other_axes)
        log_scales[index] += math.log(self.long_axis / self.other_axes)
        logits = math.log(self.opacity) - np.log1p(np.exp(-logits) - self.opacity)  # logit of a fraction of the opacity
        edit.choose(is_split, copies=2, old_rows=0)
        edit.set_children("means", rows, np.stack([means + offset, means - offset], axis=1))
        edit.set_children("log_scales", rows, np.stack([log_scales, log_scales], axis=1))
        edit.set_children("logit_opacity", rows, np.stack([logits, logits], axis=1))


class PruneLowestOpacity(Rule):
    """Remove the fraction of Gaussians with the lowest opacities.

    Use it some steps after a reset of all opacities.  By then, the Gaussians that many views need have recovered,
    and the faintest Gaussians fit only a few views.
    """

    type: Literal["prune_lowest_opacity"] = "prune_lowest_opacity"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share"})

    share: UnitInterval = 0.2
    """Fraction of the Gaussians that is removed."""

    def mark(self, edit: Edit) -> None:
        logits, is_remaining = edit.gaussians.get("logit_opacity")[:, 0], edit.row_counts() > 0
        edit.choose(select_largest(-logits, int(self.share * is_remaining.sum()), is_remaining), copies=0, old_rows=0)


class SquareRoot(Budget):
    """Grow to a given number B, in proportion to the square root of the training progress x: B √x."""

    type: Literal["square_root"] = "square_root"
    training_keys: ClassVar[frozenset[str]] = frozenset({"gaussians"})

    gaussians: Annotated[int, Field(ge=1)]
    """The number B that the last edit may reach."""

    def limit(self, edit: Edit, context: BudgetContext, state: dict[str, float]) -> int:
        return int(self.gaussians * math.sqrt(context.progress))
