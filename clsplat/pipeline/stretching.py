"""Stretch the schedules of a pipeline to another number of training steps.

Steps, durations, and intervals are multiplied by one factor.  Stages inside `during` therefore act as often and in the
same order as before, and stages that acted at the same step still do.  Intervals may become fractional.  If two actions
then fall on one step, they happen in the order of the list.  Learning rates of parameters that are learned over the
entire training, such as those of a filter, are divided by the factor.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, TypeVar

from clsplat.core.schedule import count_fired, divide, fire_steps
from clsplat.core.settings import Settings
from clsplat.pipeline.file import PipelineFile
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize
from clsplat.training.stage import Scheduled, Training

Value = TypeVar("Value")
TrainingT = TypeVar("TrainingT", bound=Training)
MAX_STEP = 2**63 - 1  # the largest that a file can store
STEP_PARTS = 10**6  # parts of a step; intervals are multiples of a part, which a file stores exactly


@dataclass(frozen=True)
class StepScaling:
    """A mapping from steps to stretched steps: step x becomes floor(x * factor)."""

    exact: Fraction
    """Factor of the number of steps."""
    factor: Fraction
    """Factor of all other steps: `exact`, rounded up to a multiple of 1 / STEP_PARTS."""

    @classmethod
    def from_factor(cls, factor: float | Fraction) -> "StepScaling":
        """Return the scaling by a factor; a float is converted by its shortest decimal representation."""
        exact = factor if isinstance(factor, Fraction) else Fraction(str(factor))
        return cls(exact, Fraction(math.ceil(exact * STEP_PARTS), STEP_PARTS))

    def scale(self, step: int) -> int:
        """Return the stretched step that `step` becomes, at most MAX_STEP."""
        return min(math.floor(step * self.factor), MAX_STEP)

    def scale_interval(self, every: float) -> float:
        """Return a stretched interval, which is at least 1.  An interval of 1 stays 1."""
        interval = Fraction(str(every)) * self.factor
        if every == 1 or interval <= 1:
            return 1
        interval = min(interval, Fraction(MAX_STEP))
        return int(interval) if interval.denominator == 1 else float(interval)

    def scale_start(self, start: int, every: float) -> int:
        """Return the stretched `start`, which excludes the same actions as before."""
        number = count_fired(every, start)
        return max(
            0, min(max(self.scale(start), self._action_step(every, number)), self._action_step(every, number + 1) - 1)
        )

    def scale_stop(self, stop: int, every: float) -> int:
        """Return the stretched `stop`, which includes the same actions as before."""
        number = count_fired(every, stop - 1)
        return min(
            max(self._action_step(every, number) + 1, min(self.scale(stop), self._action_step(every, number + 1))),
            MAX_STEP,
        )

    def scale_until(self, until: int, every: float) -> int:
        """Return the stretched `until`, with the same number of actions before it."""
        number = count_fired(every, until - 1)
        first, last = self._action_step(every, number) + 1, self._action_step(every, number + 1)
        return max(1, min(max(first, self.scale(until)), last))

    def _action_step(self, every: float, number: int) -> int:
        return math.floor(number * Fraction(str(every)) * self.factor)


def with_steps(settings: PipelineFile, steps: int, done_steps: int) -> PipelineFile:
    """Return settings with another number of training steps.  The first `done_steps` do not change.

    If `steps` is larger than the last edit, the steps up to that edit do not change either.  Stages that start later
    start at the same fraction of the remaining steps.
    """

    def change(training: Training) -> Training:
        last = last_edit(training)
        fixed_steps = max(done_steps, last) if last < min(steps, training.steps) else done_steps
        factor = (steps - fixed_steps) / (training.steps - fixed_steps)
        during = [_stretch_stage(stage, fixed_steps, factor) for stage in training.during]
        return training.model_copy(update={"steps": steps, "during": during})

    return map_trainings(settings, Training, change)


def last_edit(training: Training) -> int:
    """Return the last step that adds or prunes Gaussians or changes the size of photos; 0 if no setting does.

    A shorter training would end with downscaled photos, or before its last pruning.
    """
    stops = [stage.stop for stage in training.during if isinstance(stage, Densify) and stage.stop is not None]
    return max([0, *stops, *([int(training.views.last_change)] if isinstance(training, Optimize) else [])])


def min_steps(training: Training) -> int:
    """Return the smallest number of steps to which a training can be scaled without two edits falling on one step."""
    edits = {
        step
        for stage in training.during
        if stage.edits and stage.every is not None and stage.every != 1
        for step in fire_steps(stage.every, stage.start, min(stage.stop or MAX_STEP, training.steps))
    }
    if isinstance(training, Optimize):
        edits |= {int(step) for step in training.views.changes}
    edits |= {rule.start for stage in training.during if isinstance(stage, Densify) for rule in stage.rules}
    gap = min((next_step - step for step, next_step in pairwise(sorted(edits - {0}))), default=training.steps)
    return -(-training.steps // gap)


def stretch_to_steps(settings: PipelineFile, steps: int) -> PipelineFile:
    """Return settings stretched to `steps` steps of the first training.  Raises ConfigError if no stage trains."""
    return stretch(settings, Fraction(steps, settings.training.steps))


def _stretch_stage(stage: Scheduled, pivot: int, factor: float) -> Scheduled:
    """Return a stage with the steps after `pivot` multiplied by `factor`, if it starts after `pivot`."""
    if stage.start <= pivot:
        return stage
    every = max(1, math.floor((stage.every or 1) * factor))
    start, stop = (
        step if step is None else pivot + math.floor((step - pivot) * factor) for step in (stage.start, stage.stop)
    )
    return stage.model_copy(update={"every": every, "start": start, "stop": stop})


def map_trainings(
    settings: PipelineFile, cls: type[TrainingT], change: Callable[[TrainingT], TrainingT]
) -> PipelineFile:
    """Return settings with `change` applied to each training stage of a class."""
    stages = [change(stage) if isinstance(stage, cls) else stage for stage in settings.stages]
    return settings.model_copy(update={"stages": stages})


def stretch(value: Value, factor: float | Fraction) -> Value:
    """Return settings for `factor` times as many steps; the `step_keys` of each class are scaled."""
    return _stretch(value, StepScaling.from_factor(factor))  # type: ignore[no-any-return]


def _stretch(value: Any, scaling: StepScaling) -> Any:
    if isinstance(value, list):
        is_points = bool(value) and all(isinstance(item, list) for item in value)
        return _points(value, scaling) if is_points else [_stretch(item, scaling) for item in value]
    if isinstance(value, dict):
        return {key: _stretch(entry, scaling) for key, entry in value.items()}
    if not isinstance(value, Settings):
        return value
    fields = {name: getattr(value, name) for name in type(value).model_fields}
    keys = {key for base in type(value).__mro__ if issubclass(base, Settings) for key in base.step_keys}
    every = fields["every"] if "every" in keys else None
    new_fields = {
        name: _steps(name, field, scaling, every) if name in keys else _stretch(field, scaling)
        for name, field in fields.items()
    }
    rates = {name: new_fields[name] for name in type(value).rate_keys if scaling.exact != 1}
    new_fields |= {name: divide(rate, float(scaling.exact)) for name, rate in rates.items()}
    return value.model_copy(update={name: new for name, new in new_fields.items() if new is not fields[name]})


def _steps(name: str, steps: Any, scaling: StepScaling, every: Any) -> Any:
    """Stretch the step number of a setting.  A start or stop stays between the same two multiples of `every`."""
    if not isinstance(steps, int | float) or steps == 0:
        return steps
    if name == "every":
        return scaling.scale_interval(steps)
    if name == "steps":
        return max(1, math.floor(steps * scaling.exact))
    scale_functions = {"start": scaling.scale_start, "stop": scaling.scale_stop, "until": scaling.scale_until}
    if name in scale_functions and every not in (None, 1):
        return scale_functions[name](int(steps), every)
    return max(1, scaling.scale(int(steps)))


def _points(points: list[list[float]], scaling: StepScaling) -> list[list[float]]:
    """Return the stretched points of a schedule; if two fall on one step, the later one is used."""
    return [list(point) for point in {math.floor(step * scaling.factor): value for step, value in points}.items()]
