"""Prune by the increase of the error in training views, and estimate the error that a Gaussian can remove."""

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
from clsplat.methods.mini_splatting import sampled_weights
from clsplat.opencl.device import Array
from clsplat.render.painter import crop
from clsplat.scene.view import View

HIDDEN_LOGIT = -40.0  # logit of an invisible opacity
COUNT_RESOLUTION = 256  # the number of Gaussians to prune is accurate to 1/256 of all Gaussians


def squared_error(survey: Survey, views: list[View]) -> float:
    """Return the squared error of the renders, summed over unmasked pixels."""
    total = 0.0
    for render in survey.render(views):
        difference = crop(render.frame, render.frame.image.get()) - render.photograph.image() / np.float32(255)
        total += float((difference[render.counted_pixels()].astype(np.float64) ** 2).sum())
    return total


def evaluate_without(gaussians: Gaussians, rows: NDArray[np.intp], function: Callable[[], float]) -> float:
    """Make the Gaussians in `rows` invisible, call `function`, restore the Gaussians, and return the result."""
    logits = gaussians.get("logit_opacity")
    hidden_logits = logits.copy()
    hidden_logits[rows] = HIDDEN_LOGIT
    gaussians.set("logit_opacity", hidden_logits)
    try:
        return function()
    finally:
        gaussians.set("logit_opacity", logits)


def find_largest_allowed(is_allowed: Callable[[int], bool], count: int) -> int:
    """Return the largest allowed number from 0 to `count`, by bisection, accurate to `count` / COUNT_RESOLUTION."""
    low, high, step = 0, count + 1, max(1, count // COUNT_RESOLUTION)
    while high - low > step:
        middle = (low + high) // 2
        low, high = (middle, high) if is_allowed(middle) else (low, middle)
    return low


class PruneRedundant(Rule):
    """Remove the Gaussians with the smallest weights in the training views until the squared error rises too much.

    The rule renders some views without the candidates to find how many it can remove.  Training then compensates for
    the increase.
    """

    type: Literal["prune_redundant"] = "prune_redundant"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"error_rise", "views"})

    error_rise: Positive = 0.01
    """Largest relative increase of the squared error: 0.01 is 0.04 dB."""
    views: Annotated[int, Field(ge=1)] = 10
    """Number of training views on which the error is measured, sampled at random; all if there are fewer."""

    def mark(self, edit: Edit) -> None:
        survey, gaussians = edit.survey, edit.gaussians
        order = np.argsort(survey.compute_once(sampled_weights).total, kind="stable")
        views = survey.sample_views(self.views)
        limit = (1 + edit.evaluate(self.error_rise)) * squared_error(survey, views)

        def is_allowed(count: int) -> bool:
            return evaluate_without(gaussians, order[:count], lambda: squared_error(survey, views)) <= limit

        is_pruned = np.zeros(len(order), bool)
        is_pruned[order[: find_largest_allowed(is_allowed, len(order))]] = True
        edit.choose(is_pruned, copies=0, old_rows=0)


class ErrorGain(Statistic):
    """Error that a Gaussian can remove over all training views, in units of the mean error of a pixel.

    The value is the change of the loss when the Gaussian moves by one standard deviation on the screen.  The unit does
    not depend on the exposure, size, and number of the images, nor on the weights of the losses.
    """

    type: Literal["gain"] = "gain"
    divisor: ClassVar[str] = "view_error"
    conflicts = NEEDS_CONIC
    is_total: ClassVar[bool] = True

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_gain(
            items=gaussians.count,
            grad_mean2d=grad_mean2d,
            splats=gradients.frame.splats,
            radius=gradients.frame.radius,
            total=total,
            factor=float(gradients.frame.camera.width * gradients.frame.camera.height),
            stride=gaussians.capacity,
            count=gaussians.count,
        )


class ViewError(Statistic):
    """Image error, weighted like the losses, over all views, even if the Gaussian is not visible in them."""

    type: Literal["view_error"] = "view_error"

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_error(
            items=gaussians.count, error=view_error(gradients.comparison), total=total, count=gaussians.count
        )
