"""Numbers that may change over training, in one notation for weights, rates, sizes, blur and thresholds.

0.8                                                     the same at every step
[[0, 4.0], [1000, 1.0]]                                 points (global step, value), straight lines between
{points: [[0, 4.0], [1000, 1.0]], between: steps}       each value from its step on, until the next
{initial: 1.6e-4, final: 1.6e-6, over: 30000, start: 0} exponential decay over a number of steps from a step on
{every: 4, value: 5.0e-4}                               at every so many steps, else 0
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


def _in_order(points: list[Point]) -> list[Point]:
    steps = [step for step, _ in points]
    if not points or steps != sorted(set(steps)):
        raise ValueError("expected points [step, value] with growing steps")
    return points


def _between(points: list[Point], step: int, linear: bool) -> float:
    (first, value), *rest = points
    for until, following in rest:
        if step <= first:
            break
        if step < until:
            return value + (following - value) * (step - first) / (until - first) if linear else value
        first, value = until, following
    return value


PointList = Annotated[list[Point], AfterValidator(_in_order)]


class Curve(Settings):
    """A value by step, given by keys of its own; a schedule takes any subclass."""

    @abstractmethod
    def at(self, step: int) -> float:
        """Return the value at a global step."""

    @property
    @abstractmethod
    def values(self) -> list[float]:
        """The values that bounds are checked on: the smallest must be among them."""

    def divide(self, factor: float) -> "Curve":
        """Return the curve with its values divided by a factor.  Raises ConfigError where it has no such values."""
        raise ConfigError(f"{type(self).__name__}: cannot follow the number of steps; expected a number or points")


class _Curves:
    """Marks a field that takes any curve, told apart by its keys."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        kinds = [kind for kind in Settings.defined if issubclass(kind, Curve) and not inspect.isabstract(kind)]
        return core_schema.union_schema([handler.generate_schema(kind) for kind in kinds])


class Points(Curve):
    """Values at steps; constant before the first point and after the last."""

    points: PointList
    """[global step, value], with growing steps."""
    between: Literal["linear", "steps"] = "linear"
    """Values between two points: on a straight line, or that of the point before."""

    def at(self, step: int) -> float:
        return _between(self.points, step, linear=self.between == "linear")

    @property
    def values(self) -> list[float]:
        return [value for _, value in self.points]

    def divide(self, factor: float) -> "Points":
        return self.model_copy(update={"points": [[step, value / factor] for step, value in self.points]})


class Decay(Curve):
    """A value that falls or grows exponentially (Kerbl et al. 2023)."""

    step_keys: ClassVar[frozenset[str]] = frozenset({"over", "start"})

    initial: Annotated[float, Field(gt=0)]
    """The value up to `start`."""
    final: Annotated[float, Field(gt=0)]
    """The value from `start + over` on."""
    over: Annotated[int, Field(gt=0)]
    """Steps from the one value to the other."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step at which the decay begins."""

    def at(self, step: int) -> float:
        share = min(max(step - self.start, 0) / self.over, 1.0)
        return math.exp((1 - share) * math.log(self.initial) + share * math.log(self.final))

    @property
    def values(self) -> list[float]:
        return [self.initial, self.final]

    def divide(self, factor: float) -> "Decay":
        return self.model_copy(update={"initial": self.initial / factor, "final": self.final / factor})


class Every(Curve):
    """A value at every so many steps, and 0 at the others (such as the rate of what may change rarely)."""

    every: Annotated[int, Field(gt=0)]
    """Steps from one value to the next."""
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
    "expected a number, points [[step, value], …] with growing steps, {points, between}, {initial, final, over, start} "
    "or {every, value}"
)


def explain_schedule(more: str = "") -> WrapValidator:
    """Make one sentence of the errors of all notations; `more` names other values that the field accepts."""
    return in_one_sentence(NOTATIONS + more)


Schedule = Annotated[float | PointList | Annotated[Curve, _Curves()], explain_schedule()]


def schedule_values(schedule: Schedule) -> list[float]:
    """Return all values of a schedule's notation."""
    if isinstance(schedule, list):
        return [value for _, value in schedule]
    return schedule.values if isinstance(schedule, Curve) else [schedule]


def divide(schedule: Schedule, factor: float) -> Schedule:
    """Return a schedule with its values divided by a factor."""
    if isinstance(schedule, list):
        return [[step, value / factor] for step, value in schedule]
    return schedule.divide(factor) if isinstance(schedule, Curve) else schedule / factor


class Bounded:
    """Requires every value of a schedule to be at least `lowest`, or, where `above`, larger; and at most `most`."""

    def __init__(self, lowest: float, above: bool = False, most: float = math.inf) -> None:
        self.lowest, self.above, self.most = lowest, above, most

    def __call__(self, schedule: Any) -> Any:
        lowest = min(schedule_values(schedule))
        if lowest < self.lowest or (self.above and lowest == self.lowest):
            bound = "larger than" if self.above else "at least"
            raise ValueError(f"expected values {bound} {self.lowest:g}")
        if max(schedule_values(schedule)) > self.most:
            raise ValueError(f"expected values of at most {self.most:g}")
        return schedule


NonNegative = Annotated[Schedule, AfterValidator(Bounded(0))]
Positive = Annotated[Schedule, AfterValidator(Bounded(0, above=True))]
Probability = Annotated[Schedule, AfterValidator(Bounded(0, maximum=0.9))]
AtLeastOne = Annotated[Schedule, AfterValidator(Bounded(1))]


def at_step(schedule: Schedule, step: int) -> float:
    """Return the value of a schedule at a global step."""
    if isinstance(schedule, list):
        return _between(schedule, step, linear=True)
    return schedule.at(step) if isinstance(schedule, Curve) else schedule


# The steps at which something acts every so many of them.

EverySteps = Annotated[
    Annotated[int, Field(gt=0)] | Annotated[float, Field(ge=1)],
    in_one_sentence("expected a number of steps of at least 1, which need not be whole"),
]


def fires_at(every: float, step: int) -> bool:
    """Return whether there is an act at a step, counted from 1."""
    return step % every == 0 if isinstance(every, int) else count_fired(every, step) > count_fired(every, step - 1)


def count_fired(every: float, step: int) -> int:
    """Return the number of acts up to a step."""
    steps, parts = _ratio(every)
    return ((step + 1) * parts - 1) // steps


def fire_step(every: float, number: int) -> int:
    """Return the step of an act, by its number, counted from 1."""
    steps, parts = _ratio(every)
    return number * steps // parts


def fire_steps(every: float, start: int, stop: int) -> list[int]:
    """Return the steps of the acts after `start` and before `stop`."""
    return [
        fire_step(every, number) for number in range(count_fired(every, start) + 1, count_fired(every, stop - 1) + 1)
    ]


@lru_cache(maxsize=1024)
def _ratio(every: float) -> tuple[int, int]:
    """The number as it is written, in decimals: exact, so that what acts together goes on doing so."""
    return Fraction(str(every)).as_integer_ratio()
