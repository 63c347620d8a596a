"""The devices and schedules that kernel tests run on, and the setting that each case of a test takes."""

import itertools
import os
from collections.abc import Iterable
from typing import Any

import pytest

NAMES = [name.strip() for name in os.environ.get("CLSPLAT_TEST_DEVICES", "").split(";")]


TUNINGS = {"wide16": ("wide", 16), "wide8": ("wide", 8), "simt": ("simt", 1), "simt16": ("simt16", 1)}


def joined(*parts: Any) -> Any:
    """One row of several values or rows, with all their marks."""
    values: list[Any] = []
    marks: list[Any] = []
    for part in parts:
        if hasattr(part, "marks"):
            values += part.values
            marks += part.marks
        else:
            values += part if isinstance(part, tuple) else (part,)
    return pytest.param(*values, marks=marks)


def case_name(value: Any) -> str:
    """A short text of a value for the name of a case."""
    if isinstance(value, tuple | list) and len(value) < 5:
        return "x".join(map(case_name, value))
    text = (
        value
        if isinstance(value, str | int | float) or value is None
        else getattr(value, "__name__", type(value).__name__)
    )
    return str(text).replace(" ", "_")


def on_devices(names: str, rows: Iterable[Any]) -> pytest.MarkDecorator:
    """Parametrize a kernel test: each row runs with one setting of each device, and all settings take their turn.

    Neighbors among the rows, which are often of one class of sizes, get different settings; where there are fewer rows
    than settings the rows come again.
    """
    settings, actual = list(TUNINGS), [joined(row) for row in rows]
    cases = []
    for name in NAMES:
        for i, row in zip(range(max(len(actual), len(settings))), itertools.cycle(actual), strict=False):
            setting = settings[(i + i // len(settings)) % len(settings)]
            text = "-".join([name, setting, *map(case_name, row.values)])
            cases.append(pytest.param((name, setting), *row.values, marks=row.marks, id=text))
    return pytest.mark.parametrize(f"device, {names}", cases, indirect=["device"])


# For what does not depend on the schedule, such as a refusal before any launch.
on_one_setting = pytest.mark.parametrize("device", [(name, "wide16") for name in NAMES], ids="-".join, indirect=True)


def each_once(*axes: Iterable[Any]) -> list[Any]:
    """Rows in which each value of each axis is there at least once; shorter axes come again, each time by one later."""
    values = [list(axis) for axis in axes]
    return [joined(*(axis[(i + i // len(axis)) % len(axis)] for axis in values)) for i in range(max(map(len, values)))]


def product(*axes: Iterable[Any]) -> list[Any]:
    """All rows; `each_once` takes them as one axis."""
    return list(itertools.product(*axes))
