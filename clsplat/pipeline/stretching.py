"""A pipeline in another number of steps: places, lengths and cadences of its training are multiplied.

So each edit that has an end is made as often, at about the same share of the training.  What is learned in so many
updates, such as a filter, has a rate that falls as much as their number grows.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, TypeVar

from clsplat.pipeline.choices import CaptureChoice
from clsplat.pipeline.file import PipelineFile
from clsplat.schedule import divided
from clsplat.settings import Settings
from clsplat.stages.base import Scheduled
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize
from clsplat.stages.training import Training

Value = TypeVar("Value")
Kind = TypeVar("Kind", bound=Training)
MOST = 2**63 - 1  # that a file can hold


def with_steps(settings: PipelineFile, steps: int, done: int) -> PipelineFile:
    """Return settings whose training has so many steps, of which those that are done are the same; stages that have not
    begun do so at the same share of the others."""

    def changed(training: Training) -> Training:
        left = (steps - done) / (training.steps - done)
        during = [_moved(stage, done, left) for stage in training.during]
        return training.model_copy(update={"steps": steps, "during": during})

    return of_trainings(settings, Training, changed)


def last_edit(training: Training) -> int:
    """Return the step up to which Gaussians grow and the photographs' size changes; 0 where that is not said.

    One that is cut before would end with small photographs, or before its last pruning.
    """
    stops = [stage.stop for stage in training.during if isinstance(stage, Densify) and stage.stop is not None]
    return max([0, *stops, *([int(training.views.last_change)] if isinstance(training, Optimize) else [])])


def in_steps(settings: PipelineFile, steps: int) -> PipelineFile:
    """Return settings stretched so that the first training has so many steps.  Raises ConfigError when none trains."""
    return stretched(settings, Fraction(steps, settings.training.steps))


def _moved(stage: Scheduled, done: int, left: float) -> Scheduled:
    if stage.start <= done:
        return stage
    every = max(1, math.floor((stage.every or 1) * left))
    start, stop = (
        place if place is None else done + math.floor((place - done) * left) for place in (stage.start, stage.stop)
    )
    return stage.model_copy(update={"every": every, "start": start, "stop": stop})


def of_trainings(settings: PipelineFile, kind: type[Kind], changed: Callable[[Kind], Kind]) -> PipelineFile:
    """Return settings with other trainings of a kind."""
    stages = [changed(stage) if isinstance(stage, kind) else stage for stage in settings.stages]
    return settings.model_copy(update={"stages": stages})


def stretched(value: Value, factor: float | Fraction) -> Value:
    """Return settings for `factor` times as many steps; each class names in `step_keys` what that changes."""
    return _stretched(value, factor)  # type: ignore[no-any-return]


def _stretched(value: Any, factor: float | Fraction) -> Any:
    if isinstance(value, list):
        is_points = bool(value) and all(isinstance(item, list) for item in value)
        return _points(value, factor) if is_points else [_stretched(item, factor) for item in value]
    if isinstance(value, CaptureChoice):  # whose rows begin with what is measured, and not with steps
        rows = [[bound, *(_stretched(one, factor) for one in row)] for bound, *row in value.values]
        given = {key: _stretched(one, factor) for key, one in value.given.items()}
        return value.model_copy(update={"values": rows, "given": given})
    if not isinstance(value, Settings):
        return value
    fields = {name: getattr(value, name) for name in type(value).model_fields}
    keys = {key for base in type(value).__mro__ if issubclass(base, Settings) for key in base.step_keys}
    every = fields["every"] if "every" in keys else None
    changed = {
        name: _steps(name, field, factor, every) if name in keys else _stretched(field, factor)
        for name, field in fields.items()
    }
    changed |= {name: divided(changed[name], float(factor)) for name in type(value).rate_keys if factor != 1}
    return value.model_copy(update={name: new for name, new in changed.items() if new is not fields[name]})


def _steps(name: str, steps: Any, factor: float | Fraction, every: Any = None) -> Any:
    """A number of steps; one that begins or ends what acts at multiples of `every` does so at the same of them."""
    if not isinstance(steps, int) or steps == 0:
        return steps
    if name == "every":
        return _cadence(steps, factor)
    if name not in ("start", "stop") or not isinstance(every, int) or every == 1:
        return max(1, min(math.floor(steps * factor), MOST))
    after = name == "stop"  # what acts at a step before it is what acts up to the step before it
    number, rest = divmod(steps - after, every)
    cadence = _cadence(every, factor)
    return min(number * cadence + min(math.floor(rest * factor), cadence - 1) + after, MOST)


def _cadence(every: int, factor: float | Fraction) -> int:
    """What acts at each step acts at each."""
    return every if every == 1 else max(1, math.floor(every * factor))


def _points(points: list[list[float]], factor: float | Fraction) -> list[list[float]]:
    """Points of a schedule; of two that fall together the later one stays."""
    return [list(point) for point in {math.floor(step * factor): value for step, value in points}.items()]
