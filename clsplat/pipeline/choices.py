"""Choices that a run makes by its photographs, and what it writes of them into its pipeline file."""

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from clsplat.scene.capture import UNITS, Measure
from clsplat.settings import Settings

WRITTEN = ("chosen", "reason")  # keys of a choice
Row = Annotated[list[Any], Field(min_length=2, max_length=2)]  # the least measure, the value


def _ascending(rows: list[Row]) -> list[Row]:
    bounds = [row[0] for row in rows]
    numbers = all(isinstance(bound, int | float) and not isinstance(bound, bool) for bound in bounds)
    if not rows or not numbers or bounds != sorted(set(bounds)) or bounds[0] != 0:
        raise ValueError("expected rows [from, value], the first one from 0, with growing numbers")
    return rows


class CaptureChoice(Settings):
    """A setting that follows from a measure of the photographs.

    It replaces what the file says at its place, before training; `--set` of that place, or of one that holds it or lies
    inside, removes the choice.  Where the dataset does not have the measure, the file's value stays.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "instead_of", "reason"})

    key: str
    """Place of the setting, as in `--set`: a key of the model, of a stage, or `scene.validation`."""
    by: Measure
    """What is measured."""
    values: Annotated[list[Row], AfterValidator(_ascending)]
    """Rows [from, value]: the value of the last row whose bound the measure reaches."""
    since: str
    """Why these values, in a few words."""
    chosen: Any = None
    """Written by a run: the value."""
    instead_of: Any = None
    """Written by a run: what stood there before."""
    reason: str = ""
    """Written by a run: what was measured."""

    def of(self, measures: dict[Measure, float], before: Any) -> "CaptureChoice":
        """Return it with what follows from the measures; before: the value that is replaced."""
        found = measures.get(self.by)
        if found is None:
            reason, value = f"the dataset does not tell {self.by}", before
        else:
            reason = f"{found:,.4g} {UNITS[self.by]}; {self.since}"
            value = next(value for bound, value in reversed(self.values) if found >= bound)
        return self.model_copy(update={"chosen": value, "instead_of": before, "reason": reason})

    def undone(self) -> "CaptureChoice":
        """Return it before a choice."""
        return self.model_copy(update={"chosen": None, "instead_of": None, "reason": ""})


def without_choices(data: Any) -> Any:
    """Return plain data of a resolved pipeline without what `auto` keys chose."""
    if isinstance(data, list):
        return [without_choices(item) for item in data]
    if not isinstance(data, dict):
        return data
    chooses = all(key in data for key in WRITTEN)
    return {key: without_choices(value) for key, value in data.items() if not (chooses and key in WRITTEN)}
