"""A pipeline in another number of steps: places, lengths and cadences of its training are multiplied.

All of them are places on one axis that is stretched, by one factor: what acts does so as often, in the same order, and
what acts at one step still does.  Cadences need not be whole for that.  Only where steps become so few that two acts
fall on one step do they act there in the order of the list.  What is learned in so many updates, such as a filter, has
a rate that falls as much as their number grows.
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
Kind = TypeVar("Kind", bound=Training)
MOST = 2**63 - 1  # that a file can hold
PARTS = 10**6  # of a step: cadences are multiples of one, exact as a file holds them


@dataclass(frozen=True)
class Axis:
    """The steps of a training, stretched: what was at a step x is at the whole step at or below x times a factor."""

    exact: Fraction
    """Of the number of steps."""
    factor: Fraction
    """Of all places: the next multiple of 1 / PARTS."""

    @classmethod
    def by(cls, factor: float | Fraction) -> "Axis":
        """Return the axis of a factor; of a float it is the number that is written so."""
        exact = factor if isinstance(factor, Fraction) else Fraction(str(factor))
        return cls(exact, Fraction(math.ceil(exact * PARTS), PARTS))

    def at(self, step: int) -> int:
        """Return where a step comes to be."""
        return min(math.floor(step * self.factor), MOST)

    def every(self, every: float) -> float:
        """Return a cadence; what acts at each step acts at each, as does what would act more often."""
        stretched = Fraction(str(every)) * self.factor
        if every == 1 or stretched <= 1:
            return 1
        bounded = min(stretched, Fraction(MOST))
        return int(bounded) if bounded.denominator == 1 else float(bounded)

    def start(self, start: int, every: float) -> int:
        """Return the step after which what acted after `start` acts: before its first act, and from the last
        one that is left out on."""
        number = count_fired(every, start)
        return max(0, min(max(self.at(start), self._act(every, number)), self._act(every, number + 1) - 1))

    def stop(self, stop: int, every: float) -> int:
        """Return the step before which what acted before `stop` acts: behind its last act."""
        number = count_fired(every, stop - 1)
        return min(max(self._act(every, number) + 1, min(self.at(stop), self._act(every, number + 1))), MOST)

    def until(self, until: int, every: float) -> int:
        """Return the step up to which acts follow, the last of them at it or next behind it: behind those before."""
        number = count_fired(every, until - 1)
        return max(1, min(max(self._act(every, number) + 1, self.at(until)), self._act(every, number + 1)))

    def _act(self, every: float, number: int) -> int:
        return math.floor(number * Fraction(str(every)) * self.factor)


def with_steps(settings: PipelineFile, steps: int, done: int) -> PipelineFile:
    """Return settings whose training has so many steps, of which those that are done are the same.

    So are those up to the last edit, where it has more.  Stages that have not begun there do so at the same share of
    the steps that follow.
    """

    def changed(training: Training) -> Training:
        last = last_edit(training)
        fixed = max(done, last) if last < min(steps, training.steps) else done
        left = (steps - fixed) / (training.steps - fixed)
        during = [_moved(stage, fixed, left) for stage in training.during]
        return training.model_copy(update={"steps": steps, "during": during})

    return of_trainings(settings, Training, changed)


def last_edit(training: Training) -> int:
    """Return the step up to which Gaussians grow and the photographs' size changes; 0 where that is not said.

    One that is cut before would end with small photographs, or before its last pruning.
    """
    stops = [stage.stop for stage in training.during if isinstance(stage, Densify) and stage.stop is not None]
    return max([0, *stops, *([int(training.views.last_change)] if isinstance(training, Optimize) else [])])


def fewest_steps(training: Training) -> int:
    """Return the fewest steps in which a training can be stretched such that no two of its edits fall on one step."""
    found = {
        step
        for stage in training.during
        if stage.edits and stage.every is not None and stage.every != 1
        for step in fire_steps(stage.every, stage.start, min(stage.stop or MOST, training.steps))
    }
    if isinstance(training, Optimize):
        found |= {int(step) for step in training.views.changes}
    found |= {rule.start for stage in training.during if isinstance(stage, Densify) for rule in stage.rules}
    apart = min((later - step for step, later in pairwise(sorted(found - {0}))), default=training.steps)
    return -(-training.steps // apart)


def in_steps(settings: PipelineFile, steps: int) -> PipelineFile:
    """Return settings stretched so that the first training has so many steps.  Raises ConfigError when none trains."""
    return stretched(settings, Fraction(steps, settings.training.steps))


def _moved(stage: Scheduled, fixed: int, left: float) -> Scheduled:
    """A stage that begins after a step that is fixed, with `left` times its steps from there on."""
    if stage.start <= fixed:
        return stage
    every = max(1, math.floor((stage.every or 1) * left))
    start, stop = (
        step if step is None else fixed + math.floor((step - fixed) * left) for step in (stage.start, stage.stop)
    )
    return stage.model_copy(update={"every": every, "start": start, "stop": stop})


def of_trainings(settings: PipelineFile, kind: type[Kind], changed: Callable[[Kind], Kind]) -> PipelineFile:
    """Return settings with other trainings of a kind."""
    stages = [changed(stage) if isinstance(stage, kind) else stage for stage in settings.stages]
    return settings.model_copy(update={"stages": stages})


def stretched(value: Value, factor: float | Fraction) -> Value:
    """Return settings for `factor` times as many steps; each class names in `step_keys` what that changes."""
    return _stretched(value, Axis.by(factor))  # type: ignore[no-any-return]


def _stretched(value: Any, axis: Axis) -> Any:
    if isinstance(value, list):
        is_points = bool(value) and all(isinstance(item, list) for item in value)
        return _points(value, axis) if is_points else [_stretched(item, axis) for item in value]
    if isinstance(value, dict):
        return {key: _stretched(one, axis) for key, one in value.items()}
    if not isinstance(value, Settings):
        return value
    fields = {name: getattr(value, name) for name in type(value).model_fields}
    keys = {key for base in type(value).__mro__ if issubclass(base, Settings) for key in base.step_keys}
    every = fields["every"] if "every" in keys else None
    changed = {
        name: _steps(name, field, axis, every) if name in keys else _stretched(field, axis)
        for name, field in fields.items()
    }
    changed |= {name: divide(changed[name], float(axis.exact)) for name in type(value).rate_keys if axis.exact != 1}
    return value.model_copy(update={name: new for name, new in changed.items() if new is not fields[name]})


def _steps(name: str, steps: Any, axis: Axis, every: Any) -> Any:
    """A number of steps; one that begins or ends what acts at multiples of `every` does so between the same of them."""
    if not isinstance(steps, int | float) or steps == 0:
        return steps
    if name == "every":
        return axis.every(steps)
    if name == "steps":
        return max(1, math.floor(steps * axis.exact))
    limits = {"start": axis.start, "stop": axis.stop, "until": axis.until}
    if name in limits and every not in (None, 1):
        return limits[name](int(steps), every)
    return max(1, axis.at(int(steps)))


def _points(points: list[list[float]], axis: Axis) -> list[list[float]]:
    """Points of a schedule; of two that fall together the later one stays."""
    return [list(point) for point in {math.floor(step * axis.factor): value for step, value in points}.items()]
