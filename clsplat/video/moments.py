"""The moments of a film's frames, for scenes that move."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clsplat.errors import ConfigError, quoted
from clsplat.formats.motion import is_moment
from clsplat.scene.view import View

Times = tuple[float, float]  # of the first and of the last frame, in [0, 1] of the scene
WHOLE: Times = (0.0, 1.0)
EXPECTED = "expected a time from 0 to 1, or two such as 0..1"


def times_of(given: "str | float | Sequence[float] | None") -> Times | None:
    """Return the moments of the first and the last frame from one number, two, or text such as 0..1; None stays.

    The second may come before the first: time runs backwards.  Raises ConfigError.
    """
    if given is None:
        return None
    parts = given.split("..") if isinstance(given, str) else [given] if isinstance(given, int | float) else list(given)
    try:
        found = [float(part) for part in parts]
    except (ValueError, TypeError):
        found = []
    if len(found) not in (1, 2) or not all(map(is_moment, found)):
        raise ConfigError(f"the time {quoted(given)}: {EXPECTED}")
    return found[0], found[-1]


def in_time(views: Sequence[View], times: Times) -> list[View]:
    """Return views at evenly spaced moments from the first to the last; of one view, the first."""
    return [replace(view, time=float(time)) for view, time in zip(views, np.linspace(*times, len(views)), strict=True)]


def as_time_runs(views: Sequence[View], times: Times | None, moves: bool) -> list[View]:
    """Return the views of a film with their moments: those asked for, or their own, or the whole of a scene that moves.

    moves: whether the model does.  Raises ConfigError where moments are asked for of a model that does not.
    """
    if times is not None:
        require_motion(moves)
        return in_time(views, times)
    if moves and any(view.time is None for view in views):
        return in_time(views, WHOLE)
    return list(views)


def require_motion(moves: bool) -> None:
    """Raise ConfigError for moments of a model that does not move."""
    if not moves:
        raise ConfigError("a time was given, and the model does not move; leave the time out")
