"""The steps at which something acts every so many of them.

Act number k = 1, 2, … is at the whole step at or below k times `every`.  So one that is not whole keeps its pace: 2.5
acts at steps 2, 5, 7, 10, …  Cadences that are multiplied by one number keep the order of their acts, and those at one
step.
"""

from fractions import Fraction
from functools import lru_cache
from typing import Annotated

from pydantic import Field

from clsplat.settings import in_one_sentence

Every = Annotated[
    Annotated[int, Field(gt=0)] | Annotated[float, Field(ge=1)],
    in_one_sentence("expected a number of steps of at least 1, which need not be whole"),
]


def is_act(every: float, step: int) -> bool:
    """Return whether there is an act at a step, counted from 1."""
    return step % every == 0 if isinstance(every, int) else acts(every, step) > acts(every, step - 1)


def acts(every: float, step: int) -> int:
    """Return the number of acts up to a step."""
    steps, parts = _ratio(every)
    return ((step + 1) * parts - 1) // steps


def place(every: float, number: int) -> int:
    """Return the step of an act, by its number, counted from 1."""
    steps, parts = _ratio(every)
    return number * steps // parts


def places(every: float, start: int, stop: int) -> list[int]:
    """Return the steps of the acts after `start` and before `stop`."""
    return [place(every, number) for number in range(acts(every, start) + 1, acts(every, stop - 1) + 1)]


@lru_cache(maxsize=1024)
def _ratio(every: float) -> tuple[int, int]:
    """The number as it is written, in decimals: exact, so that what acts together goes on doing so."""
    return Fraction(str(every)).as_integer_ratio()
