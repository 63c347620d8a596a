"""A pipeline in another number of steps: places, lengths and cadences of its training are multiplied.

So as many edits are made, each at the same share of the training.
"""

import math
from typing import Any, TypeVar

from clsplat.settings import Settings

Value = TypeVar("Value")


def stretched(value: Value, factor: float) -> Value:
    """Return settings for `factor` times as many steps; each class names in `step_keys` what that changes."""
    return _stretched(value, factor)  # type: ignore[no-any-return]


def _stretched(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        is_points = bool(value) and all(isinstance(item, list) for item in value)
        return _points(value, factor) if is_points else [_stretched(item, factor) for item in value]
    if not isinstance(value, Settings):
        return value
    fields = {name: getattr(value, name) for name in type(value).model_fields}
    keys = {key for base in type(value).__mro__ if issubclass(base, Settings) for key in base.step_keys}
    changed = {
        name: _steps(name, field, factor) if name in keys else _stretched(field, factor)
        for name, field in fields.items()
    }
    return value.model_copy(update={name: new for name, new in changed.items() if new is not fields[name]})


def _steps(name: str, steps: Any, factor: float) -> Any:
    """A number of steps; what ends before a step ends after the last of the steps before it, what acts at each step
    acts at each."""
    if not isinstance(steps, int) or steps == 0 or (name == "every" and steps == 1):
        return steps
    return math.ceil(steps * factor) if name == "stop" else max(1, math.floor(steps * factor))


def _points(points: list[list[float]], factor: float) -> list[list[float]]:
    """Points of a schedule; of two that fall together the later one stays."""
    return [list(point) for point in {math.floor(step * factor): value for step, value in points}.items()]
