"""Weights that may change over training: a number, or points with straight lines between them."""

from typing import Annotated

from pydantic import AfterValidator, Field

Point = Annotated[list[float], Field(min_length=2, max_length=2)]  # global step, weight


def _in_order(points: list[Point]) -> list[Point]:
    steps = [step for step, _ in points]
    if not points or steps != sorted(set(steps)):
        raise ValueError("expected points [step, weight] with growing steps")
    return points


Weight = float | Annotated[list[Point], AfterValidator(_in_order)]


def at_step(weight: Weight, step: int) -> float:
    """The weight at a global step; before the first point and after the last it stays as there."""
    if not isinstance(weight, list):
        return weight
    (first, value), *rest = weight
    for until, following in rest:
        if step <= first:
            break
        if step < until:
            return value + (following - value) * (step - first) / (until - first)
        first, value = until, following
    return value
