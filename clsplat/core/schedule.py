"""Define schedules: numbers that may change over training, such as weights, learning rates, and thresholds.

0.8                                                     constant
[[0, 4.0], [1000, 1.0]]                                 points (global step, value), linearly interpolated
{points: [[0, 4.0], [1000, 1.0]], between: steps}       piecewise constant: each value from its step on
{initial: 1.6e-4, final: 1.6e-6, over: 30000, start: 0} exponential decay over a number of steps
{every: 4, value: 5.0e-4}                               the value at every 4th step, else 0
"""

import inspect
import math
from abc import abstractmethod
from fractions import Fraction
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, GetCoreSchemaHandler, WrapValidator
from pydantic_core import CoreSchema, core_schema

from clsplat.core.errors import ConfigError
from clsplat.core.settings import Settings, in_one_sentence

Point = Annotated[list[float], Field(min_length=2, max_length=2)]  # global step, value


def _require_increasing_steps(points: list[Point]) -> list[Point]:
    steps = [step for step, _ in points]
    if not points or steps != sorted(set(steps)):
        raise ValueError("expected points [step, value] with increasing steps")
    return points


def _interpolate(points: list[Point], step: int, linear: bool) -> float:
    (start, value), *later = points
    for end, end_value in later:
        if step <= start:
            break
        if step < end:
            return value + (end_value - value) * (step - start) / (end - start) if linear else value
        start, value = end, end_value
    return value


PointList = Annotated[list[Point], AfterValidator(_require_increasing_steps)]


class Curve(Settings):
    """A schedule given as a mapping.  A `Schedule` field accepts any subclass, including those of plug-ins."""

    @abstractmethod
    def at(self, step: int) -> float:
        """Return the value at a global step."""

    @property
    @abstractmethod
    def values(self) -> list[float]:
        """The values of the curve, including the smallest and the largest, for checks against bounds."""

    def divide(self, factor: float) -> "Curve":
        """Return the curve with its values divided by a factor.  Raises ConfigError if the curve does not allow it."""
        raise ConfigError(
            f"{type(self).__name__}: cannot be rescaled to another number of steps; use a number or a list of points"
        )


class _Curves:
    """An annotation of a field that accepts any curve, recognized by its keys."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        classes = [cls for cls in Settings.subclasses if issubclass(cls, Curve) and not inspect.isabstract(cls)]
        return core_schema.union_schema([handler.generate_schema(cls) for cls in classes])


class Points(Curve):
    """Values at steps; constant before the first point and after the last."""

    points: PointList
    """[global step, value], with increasing steps."""
    between: Literal["linear", "steps"] = "linear"
    """Values between two points: `linear` interpolates, `steps` keeps the earlier value."""

    def at(self, step: int) -> float:
        return _interpolate(self.points, step, linear=self.between == "linear")

    @property
    def values(self) -> list[float]:
        return [value for _, value in self.points]

    def divide(self, factor: float) -> "Points":
        return self.model_copy(update={"points": [[step, value / factor] for step, value in self.points]})


class Decay(Curve):
    """A value that decays or grows exponentially, like the learning rates of Kerbl et al. 2023."""

    step_keys: ClassVar[frozenset[str]] = frozenset({"over", "start"})

    initial: Annotated[float, Field(gt=0)]
    """The value up to `start`."""
    final: Annotated[float, Field(gt=0)]
    """The value from `start + over` on."""
    over: Annotated[int, Field(gt=0)]
    """Number of steps from `initial` to `final`."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step at which the decay starts."""

    def at(self, step: int) -> float:
        fraction = min(max(step - self.start, 0) / self.over, 1.0)
        return math.exp((1 - fraction) * math.log(self.initial) + fraction * math.log(self.final))

    @property
    def values(self) -> list[float]:
        return [self.initial, self.final]

    def divide(self, factor: float) -> "Decay":
        return self.model_copy(update={"initial": self.initial / factor, "final": self.final / factor})


class Every(Curve):
    """A value at every N-th step and 0 at all other steps, such as a learning rate for rare updates."""

    every: Annotated[int, Field(gt=0)]
    """Interval in steps."""
    value: float
    """The value at global steps that are multiples of `every`."""

    def at(self, step: int) -> float:
        return self.value if step % self.every == 0 else 0.0

    @property
    def values(self) -> list[float]:
        return [self.value, 0.0]

    def divide(self, factor: float) -> "Every":
        return self.model_copy(update={"value": self.value / factor})


NOTATIONS = (
    "expected a number, points [[step, value], …] with increasing steps, {points, between}, "
    "{initial, final, over, start} or {every, value}"
)


def explain_schedule(more: str = "") -> WrapValidator:
    """Return a validator that reports an error in any notation of a schedule as one sentence.

    more: text about other accepted values, for the end of the sentence
    """
    return in_one_sentence(NOTATIONS + more)


Schedule = Annotated[float | PointList | Annotated[Curve, _Curves()], explain_schedule()]


def schedule_values(schedule: Schedule) -> list[float]:
    """Return all values in a schedule, including its smallest and largest."""
    if isinstance(schedule, list):
        return [value for _, value in schedule]
    return schedule.values if isinstance(schedule, Curve) else [schedule]


def divide(schedule: Schedule, factor: float) -> Schedule:
    """Return a schedule with its values divided by a factor."""
    if isinstance(schedule, list):
        return [[step, value / factor] for step, value in schedule]
    return schedule.divide(factor) if isinstance(schedule, Curve) else schedule / factor


class Bounded:
    """A validator that requires values of at least `minimum` (larger if `exclusive`) and at most `maximum`."""

    def __init__(self, minimum: float, exclusive: bool = False, maximum: float = math.inf) -> None:
        self.minimum, self.exclusive, self.maximum = minimum, exclusive, maximum

    def __call__(self, schedule: Any) -> Any:
        lowest = min(schedule_values(schedule))
        if lowest < self.minimum or (self.exclusive and lowest == self.minimum):
            bound = "larger than" if self.exclusive else "at least"
            raise ValueError(f"expected values {bound} {self.minimum:g}")
        if max(schedule_values(schedule)) > self.maximum:
            raise ValueError(f"expected values of at most {self.maximum:g}")
        return schedule


NonNegative = Annotated[Schedule, AfterValidator(Bounded(0))]
Positive = Annotated[Schedule, AfterValidator(Bounded(0, exclusive=True))]
Probability = Annotated[Schedule, AfterValidator(Bounded(0, maximum=0.9))]
AtLeastOne = Annotated[Schedule, AfterValidator(Bounded(1))]


def at_step(schedule: Schedule, step: int) -> float:
    """Return the value of a schedule at a global step."""
    if isinstance(schedule, list):
        return _interpolate(schedule, step, linear=True)
    return schedule.at(step) if isinstance(schedule, Curve) else schedule


# Events that fire at a fixed interval of steps, which need not be a whole number.

EverySteps = Annotated[
    Annotated[int, Field(gt=0)] | Annotated[float, Field(ge=1)],
    in_one_sentence("expected a number of steps of at least 1; fractions are allowed"),
]


def fires_at(every: float, step: int) -> bool:
    """Return whether an event fires at a step, counted from 1."""
    return step % every == 0 if isinstance(every, int) else count_fired(every, step) > count_fired(every, step - 1)


def count_fired(every: float, step: int) -> int:
    """Return how often the event has fired up to and including a step."""
    steps, events = _ratio(every)
    return ((step + 1) * events - 1) // steps


def fire_step(every: float, number: int) -> int:
    """Return the step at which the event fires for the `number`-th time, counted from 1."""
    steps, events = _ratio(every)
    return number * steps // events


def fire_steps(every: float, start: int, stop: int) -> list[int]:
    """Return the steps after `start` and before `stop` at which the event fires."""
    return [
        fire_step(every, number) for number in range(count_fired(every, start) + 1, count_fired(every, stop - 1) + 1)
    ]


@lru_cache(maxsize=1024)
def _ratio(every: float) -> tuple[int, int]:
    """Return an interval as an exact ratio of integers: 0.1, which float64 cannot represent, is 1 / 10."""
    return Fraction(str(every)).as_integer_ratio()
