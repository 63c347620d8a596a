"""Choices that a run makes by its photographs, and what it writes of them into its pipeline file."""

import json
import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.settings import Settings
from clsplat.scene.quality import Measure, Measures, told

WRITTEN = ("chosen", "reason")  # keys of a choice
Others = Literal["row", "file"]
Row = Annotated[list[Any], Field(min_length=2)]  # the least measure, or of each measure, then the value of each key


def _is_number(bound: Any) -> bool:
    return isinstance(bound, int | float) and not isinstance(bound, bool) and abs(bound) < math.inf


class CaptureChoice(Settings):
    """Settings that go together, and follow from a measure of the photographs.

    They replace what the file says at their places, before training; `--set` of one of these places, or of one that
    holds it or lies inside, wins there alone.  Where the others do not go together with it, or the dataset does not
    have the measure, the file's values stay.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "instead_of", "reason"})

    keys: Annotated[list[str], Field(min_length=1)]
    """Places of the settings, as in `--set`: keys of the model, of stages, or `scene.validation`."""
    by: Measure | Annotated[list[Measure], Field(min_length=2)]
    """What is measured; a list of several, whose bounds in each row are a list too."""
    values: list[Row]
    """Rows [from, a value of each key]: those of the last row all of whose bounds the measures reach.  Of several
    measures, one that the dataset does not have reaches 0 alone."""
    since: str | list[str]
    """Why these values, in a few words: of all rows, or of each."""
    given: dict[str, Any] = Field({})
    """Written for `--set`: values that take the place of those in the rows, by key."""
    chosen: list[Any] | None = None
    """Written by a run: the values."""
    instead_of: list[Any] | None = None
    """Written by a run: what stood there before."""
    reason: str = ""
    """Written by a run: what was measured."""

    @model_validator(mode="after")
    def _in_order(self) -> "CaptureChoice":
        several = isinstance(self.by, list)
        if len(set(self.measures)) < len(self.measures):
            raise ValueError("expected measures, each once, in 'by'")
        if any(isinstance(row[0], list) != several for row in self.values):
            raise ValueError(f"expected rows [{'[from, …]' if several else 'from'}, values…], as 'by' is")
        bounds = [self.bounds(row) for row in self.values]
        if wrong := next((row for row in bounds if len(row) != len(self.measures)), None):
            raise ValueError(
                f"values: expected a bound of each of {', '.join(self.measures)}, got {len(wrong)} of them"
            )
        shaped = all(_is_number(bound) for row in bounds for bound in row)
        if not bounds or not shaped or bounds != sorted(set(bounds)) or any(bounds[0]):
            raise ValueError("expected rows [from, values…], the first one from 0, with growing finite numbers")
        return self

    @model_validator(mode="after")
    def _of_each_key(self) -> "CaptureChoice":
        if wrong := next((row for row in self.values if len(row) != 1 + len(self.keys)), None):
            raise ValueError(f"values: expected [from, {', '.join(self.keys)}], got {len(wrong)} of them")
        if isinstance(self.since, list) and len(self.since) != len(self.values):
            raise ValueError(f"since: expected words, or words for each of {len(self.values)} rows")
        if wrong_key := next((key for key in self.given if key not in self.keys), None):
            raise ValueError(f"given: expected some of {', '.join(self.keys)}, got {wrong_key}")
        written = [len(values or []) for values in (self.chosen, self.instead_of)]
        if written != [len(self.keys) if self.reason else 0] * 2:
            raise ValueError(
                f"expected chosen and instead_of with a value of each of {len(self.keys)} keys, and reason, as a run "
                "writes them; without all three the run chooses anew"
            )
        return self

    @property
    def measures(self) -> list[Measure]:
        """What is measured."""
        return self.by if isinstance(self.by, list) else [self.by]

    def bounds(self, row: Row) -> tuple[float, ...]:
        """The bound of each measure in a row."""
        return tuple(row[0]) if isinstance(self.by, list) else (row[0],)

    def row(self, measures: Measures) -> int:
        """Return the number of the row that measures reach; one that is missing counts as 0."""
        found = [measures.get(name, 0) for name in self.measures]
        bounds = [zip(found, self.bounds(row), strict=True) for row in self.values]
        return max(number for number, row in enumerate(bounds) if all(value >= bound for value, bound in row))

    def depends(self, measure: Measure, measures: Measures) -> bool:
        """Whether the row depends on one more measure, beside those that are known."""
        return len({self.row({**measures, measure: value}) for value in (0.0, math.inf)}) > 1

    def of(self, measures: Measures, before: list[Any], others: Others = "row") -> "CaptureChoice":
        """Return it with what follows from the measures; before: the values that are replaced.

        others: whether what stands beside `given` values is of the row that the measure reaches, or of the file.
        """
        found = [told(name, measures[name]) for name in self.measures if name in measures]
        missing = [name for name in self.measures if name not in measures and self.depends(name, measures)]
        untold = [f"the dataset does not tell {name}" for name in missing]
        if not found:
            reason, chosen = f"the dataset does not tell {', '.join(self.measures)}", before
        else:
            at = self.row(measures)
            chosen = self.values[at][1:]
            why = self.since if isinstance(self.since, str) else self.since[at]
            reason = f"{', '.join(found + untold)}; {why}"
        if self.given:
            keys = ", ".join(self.given)
            alone = others == "file" and bool(found)
            reason += f"; {keys} as set" + (", with which the rest does not go together" if alone else "")
            beside = before if alone else chosen
            chosen = [self.given.get(key, value) for key, value in zip(self.keys, beside, strict=True)]
        return self.model_copy(update={"chosen": chosen, "instead_of": before, "reason": reason})

    @property
    def settings(self) -> list[tuple[str, Any]]:
        """Each key with what was chosen for it."""
        return list(zip(self.keys, self.chosen or [], strict=True))

    @property
    def told(self) -> str:
        """What was chosen, and why."""
        return f"{self._text([value for _, value in self.settings])}, since {self.reason}"

    def is_settled(self, known: Measures) -> bool:
        """Whether it is made, or measures that are known make it whatever the others are."""
        return bool(self.reason) or (len(self._open(known)) == 1 and any(name in known for name in self.measures))

    def possible(self, known: Measures) -> str:
        """Return what can be chosen, in words, where some measures are known; of later rows the values alone."""
        rows = self._open(known)
        values = [
            [self.given.get(key, value) for key, value in zip(self.keys, self.values[row][1:], strict=True)]
            for row in rows
        ]
        texts = [self._text(values[0]), *(", ".join(map(json.dumps, one)) for one in values[1:])]
        return "; ".join(text + self._condition(row, known) for row, text in zip(rows, texts, strict=True))

    def _open(self, known: Measures) -> list[int]:
        """The rows that the measures may reach: they do where those that are not known have the bounds of the row."""
        bounds = [dict(zip(self.measures, self.bounds(row), strict=True)) for row in self.values]
        return [number for number, own in enumerate(bounds) if self.row({**own, **known}) == number]

    def _condition(self, number: int, known: Measures) -> str:
        """The bounds of a row, of measures that are not known."""
        bounds = zip(self.measures, self.bounds(self.values[number]), strict=True)
        least = " and ".join(told(name, bound) for name, bound in bounds if bound and name not in known)
        return f" if at least {least}" if least else ""

    def _text(self, values: list[Any]) -> str:
        return ", ".join(f"{key}={json.dumps(value)}" for key, value in zip(self.keys, values, strict=True))

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
