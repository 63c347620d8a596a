"""Pruning by what the training views lose without the Gaussians (ours)."""

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import NEEDS_CONIC, Statistic
from clsplat.density.survey import Survey
from clsplat.gaussians.gaussians import Gaussians
from clsplat.losses.base import ViewGradients
from clsplat.losses.image import view_error
from clsplat.methods.mini_splatting import drawn_weights
from clsplat.opencl.device import Array
from clsplat.render.painter import inside
from clsplat.scene.view import View

HIDDEN = -40.0  # logit of an opacity that no pixel shows
FRACTION = 256  # the number is found to one part in so many


def squared_error(survey: Survey, views: list[View]) -> float:
    """Return the squared differences of images and photographs, summed over the pixels that count."""
    total = 0.0
    for look in survey.render(views):
        difference = inside(look.frame, look.frame.image.get()) - look.photograph.image() / np.float32(255)
        total += float((difference[look.counted()].astype(np.float64) ** 2).sum())
    return total


def without(gaussians: Gaussians, rows: NDArray[np.intp], function: Callable[[], float]) -> float:
    """Return what a function says while the Gaussians of some rows are not shown; they are as before then."""
    held = gaussians.get("logit_opacity")
    hidden = held.copy()
    hidden[rows] = HIDDEN
    gaussians.set("logit_opacity", hidden)
    try:
        return function()
    finally:
        gaussians.set("logit_opacity", held)


def most(allowed: Callable[[int], bool], count: int) -> int:
    """Return a number, 0 to `count`, that is allowed, by halving: the next one, a 256th of `count` above, is not."""
    low, high, step = 0, count + 1, max(1, count // FRACTION)
    while high - low > step:
        middle = (low + high) // 2
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return low


class PruneRedundant(Rule):
    """Remove the Gaussians with the least weight in the training views: as many as raise the views' squared error by
    at most a share of it.

    How many that are is found by rendering some of the views without them.  Training goes on to make up for the rise.
    """

    type: Literal["prune_redundant"] = "prune_redundant"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"error_rise", "views"})

    error_rise: Positive = 0.01
    """Largest rise of the squared error, a share of it: 0.01 is 0.04 dB; by step."""
    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views that it is measured on, drawn by seed and step; all where there are no more."""

    def mark(self, edit: Edit) -> None:
        survey, gaussians = edit.survey, edit.gaussians
        order = np.argsort(survey.cached(drawn_weights).total, kind="stable")
        views = survey.sample_views(self.views)
        limit = (1 + edit.at(self.error_rise)) * squared_error(survey, views)

        def allowed(number: int) -> bool:
            return without(gaussians, order[:number], lambda: squared_error(survey, views)) <= limit

        chosen = np.zeros(len(order), bool)
        chosen[order[: most(allowed, len(order))]] = True
        edit.choose(chosen, copies=0, kept=0)


# What a Gaussian promises to take away of the error, in a unit that all scenes share (ours).


class ErrorGain(Statistic):
    """How many pixels' errors a Gaussian promises to take away: those of mean pixels, over all training views (ours).

    It is what the loss changes by a shift of one standard deviation on the screen, whatever the photographs' exposure,
    size and number and the losses' weights.
    """

    type: Literal["gain"] = "gain"
    divisor: ClassVar[str] = "view_error"
    conflicts = NEEDS_CONIC
    is_total: ClassVar[bool] = True

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_gain(
            items=gaussians.count,
            grad_mean2d=grad_mean2d,
            splats=view.frame.splats,
            radius=view.frame.radius,
            total=total,
            factor=float(view.frame.camera.width * view.frame.camera.height),
            stride=gaussians.capacity,
            count=gaussians.count,
        )


class ViewError(Statistic):
    """The error of the views in the losses' own measure, of those that do not see the Gaussian too."""

    type: Literal["view_error"] = "view_error"

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_error(
            items=gaussians.count, error=view_error(view.comparison), total=total, count=gaussians.count
        )
