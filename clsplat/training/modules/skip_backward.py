"""Which steps skip the backward pass: those whose view has converged."""

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
COUNTS = ("steps", "whole", "warm_up", "above")  # names in the numbers of a run, in the folder `skip`


@dataclass(frozen=True)
class Visit:
    """What a step does with its view."""

    skipped: bool = False
    scalars: Mapping[str, float] = field(default_factory=dict)  # those that change when the step is done


class Skip(TrainingModule):
    """Skip the backward pass and the update where a view has converged (SkipGS, Li et al. 2026).

    Every step after `start` renders its view, compares it, and adds the loss to the moving average of the view's
    losses; a step whose loss is not above the average does nothing else.  A warm-up, in which nothing is skipped, finds
    the least share of steps that do the whole work.  Ours, where the published text is silent: that share is one of all
    steps after `start`, with those of the warm-up; a view's first visit has no average, and is never skipped; a size of
    a view has an average of its own; penalties are no part of the loss.

    A step that is skipped updates nothing: no parameter, no moment and no count of Adam's updates, no statistic (their
    means are over the views that were not skipped), no number of another module; penalties are not computed,
    and the loss that is recorded is without them.  It counts as a step: rates, weights, the order of views and all
    stages of `during`, those that edit or add noise too, go on.
    """

    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    order: ClassVar[int] = 99  # it reads the losses of all others
    optional_on_resume: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "decay", "warm_up", "least"})

    type: Literal["skip"] = "skip"
    start: Annotated[int, Field(ge=0)]
    """Global step after which steps may be skipped: where growth has ended and photographs have their full size."""
    decay: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Share of a view's average that stays at a visit."""
    warm_up: Annotated[int, Field(gt=0)] = 500
    """Steps from `start` on that are not skipped; `auto` needs several for each photograph."""
    least: Annotated[
        Literal["auto"] | Annotated[float, Field(ge=0, le=1)], in_one_sentence("expected 'auto' or a share from 0 to 1")
    ] = "auto"
    """Least share of steps that do the whole work; `auto`: the share of the warm-up that would not have been
    skipped."""

    def create_state(self, run: Run) -> ModuleState:
        return SkipState(self, run.scene.split("train"))

    def decide(self, name: str, loss: float, scalars: Mapping[str, float]) -> Visit:
        """Decide on a step after `start`; name: of the view's average."""
        if not math.isfinite(loss):
            return Visit()
        steps, whole, warm_up, above = (scalars.get(f"skip/{count}", 0.0) for count in COUNTS)
        average, steps = scalars.get(name), steps + 1
        converged = average is not None and loss <= average
        if warming := warm_up < self.warm_up:
            warm_up, above = warm_up + 1, above + (not converged)
        skipped = converged and not warming and whole >= self.share(above, warm_up) * steps
        counts = steps, whole + (not skipped), warm_up, above
        after = loss if average is None else self.decay * average + (1 - self.decay) * loss
        return Visit(skipped, {name: after, **dict(zip((f"skip/{count}" for count in COUNTS), counts, strict=True))})

    def share(self, above: float, warm_up: float) -> float:
        """The least share of whole steps; warm_up: its steps so far, of which so many were `above` the average."""
        return above / max(warm_up, 1) if self.least == "auto" else self.least


class SkipState(ModuleState):
    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Skip, views: Sequence[View]) -> None:
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
        self.scalars.update(visit.scalars if (visit := step.saved(self)) else {})

    update_skipped = update

    def finish(self, run: Run) -> None:
        """Say and record how many steps were skipped."""
        steps, whole, warm_up, above = (self.scalars.get(f"skip/{count}", 0.0) for count in COUNTS)
        least, skipped = self.settings.share(above, warm_up), steps - whole
        run.records.add(run.step, "skip", steps=int(steps), skipped=int(skipped), least=least)
        whole_at_least = f"at least {least:.1%} were to do the whole work"
        LOG.info(
            f"{skipped:,.0f} of {steps:,.0f} steps after step {self.settings.start:,} were skipped; {whole_at_least}"
        )
