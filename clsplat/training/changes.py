"""Settings of a run that may change when it goes on, and those in which two resolved pipelines differ."""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from clsplat.errors import shortened

STAGE = r"stages\[(?P<stage>\d+)\]"
DURING = rf"{STAGE}\.\w+\.during\[\d+\]"
OUTPUTS = (  # what is measured and written; the model does not depend on it
    r"scene\.image_budget",
    rf"{STAGE}\.(evaluate|export|render|report|checkpoint)\b.*",
    rf"{STAGE}\.\w+\.log_every",
    rf"{DURING}\.(evaluate|export|checkpoint)\..*",
)
TRAINING = (  # numbers of the training; no table of the Gaussians depends on them
    rf"{STAGE}\.\w+\.steps",
    rf"{STAGE}\.\w+\.rates\..*",
    rf"{STAGE}\.\w+\.losses\[\d+\]\.weight\b.*",
    rf"{DURING}\.\w+\.(every|start|stop|to)",
    rf"{DURING}\.\w+\.max_gaussians\b.*",
    rf"{DURING}\.\w+\.rules\[\d+\]\.\w+",  # a number in the place of another
)


class Difference(NamedTuple):
    """A setting in which two resolved pipelines differ."""

    place: str  # such as stages[1].optimize.rates.quats
    was: Any
    now: Any

    def __str__(self) -> str:
        return f"{self.place} was {shortened(repr(self.was), 80)}, is {shortened(repr(self.now), 80)}"

    @property
    def of_outputs(self) -> bool:
        """Whether the trained model does not depend on the setting."""
        return self._match(OUTPUTS) is not None

    @property
    def stage(self) -> int | None:
        """The stage whose training goes on with the new value; None where a run cannot go on with it."""
        found = self._match(TRAINING)
        if found is None or (".rules[" in self.place and not (_is_number(self.was) and _is_number(self.now))):
            return None
        return int(found["stage"])

    def _match(self, patterns: tuple[str, ...]) -> re.Match[str] | None:
        return next((found for pattern in patterns if (found := re.fullmatch(pattern, self.place))), None)


def differences(old: Any, new: Any, place: str = "") -> Iterator[Difference]:
    """Yield the settings in which two resolved pipelines differ, in their order."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            yield from differences(old.get(key), new.get(key), f"{place}.{key}" if place else str(key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (before, after) in enumerate(zip(old, new, strict=True)):
            yield from differences(before, after, f"{place}[{i}]")
    elif old != new:
        yield Difference(place, old, new)


def first_difference(old: Any, new: Any) -> Difference | None:
    """Return the first setting in which two resolved pipelines differ, or None."""
    return next(differences(old, new), None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
