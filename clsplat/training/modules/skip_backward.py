"""Skip the backward pass of steps whose view has converged."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.core.settings import in_one_sentence
from clsplat.scene.view import View
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
COUNTS = ("steps", "whole", "warm_up", "above")  # names of scalars after `skip/`; whole: full steps


@dataclass(frozen=True)
class Visit:
    """The decision about one step."""

    skipped: bool = False
    scalars: Mapping[str, float] = field(default_factory=dict)  # new values, set when the step is done


class SkipBackward(TrainingModule):
    """Skip the backward pass and the update of views that have converged (SkipGS, Li et al. 2026).

    Every step after `start` renders its view and adds the loss to a moving average for that view.  If the loss is not
    above the average, the remainder of the step is skipped.  During a warm-up nothing is skipped; it determines the
    smallest fraction of full steps.  The paper does not specify the following, so we chose: the fraction counts all
    steps after `start`, including the warm-up; the first visit of a view is never skipped; each size of a view has its
    own average; penalties are not part of the loss.

    A skipped step updates nothing: no parameter, no moment or update count of Adam, no statistic, and no other module.
    Its penalties are not computed, and are missing from the recorded loss.  It still counts as a step for schedules,
    the order of views, and the stages of `during`.
    """

    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    order: ClassVar[int] = 99  # it reads the losses of all others
    optional_on_resume: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "decay", "warm_up", "min_fraction"})

    type: Literal["skip_backward"] = "skip_backward"
    start: Annotated[int, Field(ge=0)]
    """Global step after which steps may be skipped.  Choose one after growth, with photographs at full size."""
    decay: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Decay of the moving average, per visit of a view."""
    warm_up: Annotated[int, Field(gt=0)] = 500
    """Number of steps after `start` that are never skipped; `auto` needs several per photograph."""
    min_fraction: Annotated[
        Literal["auto"] | Annotated[float, Field(ge=0, le=1)], in_one_sentence("expected auto, or a number from 0 to 1")
    ] = "auto"
    """Smallest fraction of full steps; `auto`: the fraction of the warm-up that would not have been skipped."""

    def create_state(self, run: Run) -> ModuleState:
        return SkipBackwardState(self, run.scene.split("train"))

    def decide(self, name: str, loss: float, scalars: Mapping[str, float]) -> Visit:
        """Decide whether to skip a step after `start`.  name: name of the scalar that holds the view's average."""
        if not math.isfinite(loss):
            return Visit()
        steps, full, warm_up, above = (scalars.get(f"skip/{count}", 0.0) for count in COUNTS)
        average, steps = scalars.get(name), steps + 1
        has_converged = average is not None and loss <= average
        if is_warm_up := warm_up < self.warm_up:
            warm_up, above = warm_up + 1, above + (not has_converged)
        skipped = has_converged and not is_warm_up and full >= self.fraction(above, warm_up) * steps
        counts = steps, full + (not skipped), warm_up, above
        average = loss if average is None else self.decay * average + (1 - self.decay) * loss
        return Visit(skipped, {name: average, **dict(zip((f"skip/{key}" for key in COUNTS), counts, strict=True))})

    def fraction(self, above: float, warm_up: float) -> float:
        """Return the smallest fraction of full steps.  above: number of warm-up steps with a loss above the average."""
        return above / max(warm_up, 1) if self.min_fraction == "auto" else self.min_fraction


class SkipBackwardState(ModuleState):
    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: SkipBackward, views: Sequence[View]) -> None:
        super().__init__()
        self.settings, self.names = settings, [view.name for view in views]

    def after_losses(self, step: TrainingStep) -> None:
        if step.number <= self.settings.start or step.view is None:
            return
        camera = step.camera
        name = f"skip/loss/{camera.width}x{camera.height}/{self.names[step.view]}"
        visit = self.settings.decide(name, step.loss, self.scalars)
        step.skipped |= visit.skipped
        step.save(self, visit)

    def update(self, step: TrainingStep) -> None:
        if visit := step.saved(self):
            self.scalars.update(visit.scalars)

    update_skipped = update

    def finish(self, run: Run) -> None:
        """Log and record how many steps were skipped."""
        steps, full, warm_up, above = (self.scalars.get(f"skip/{count}", 0.0) for count in COUNTS)
        fraction, skipped = self.settings.fraction(above, warm_up), steps - full
        run.records.add(run.step, "skip", steps=int(steps), skipped=int(skipped), min_fraction=fraction)
        after = f"after step {self.settings.start:,}"
        LOG.info(f"skipped {skipped:,.0f} of {steps:,.0f} steps {after}; at least {fraction:.1%} had to be full steps")
