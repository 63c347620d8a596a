"""Read and write times.json, which contains the timestamp of each photograph in a folder, in any unit."""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from clsplat.core.errors import DataError, quote
from clsplat.core.files import write_text
from clsplat.core.reading import read_json
from clsplat.scene.points import BELOW_MAX, MAX_VALUE
from clsplat.scene.times import make_clock
from clsplat.scene.view import View

FILE = "times.json"
MAX_BYTES = 1 << 26


def write_times(folder: Path, times: Mapping[str, float]) -> None:
    """Write the timestamps of photographs, by their paths relative to `folder`.  Raises OutputError."""
    write_text(folder / FILE, json.dumps(dict(times), indent=1) + "\n")


def read_times(folder: Path) -> dict[str, float] | None:
    """Return the timestamps in the times.json of `folder` by photograph, or None without that file.

    Raises DataError.
    """
    path = folder / FILE
    if not os.path.lexists(path):  # reading reports a path that is not a file
        return None
    table = read_json(path, "timestamps of photos in JSON", limit=MAX_BYTES)
    if not isinstance(table, dict):
        raise DataError(f"{path}: expected a JSON object that maps the name of each photo to a number")
    for name, value in table.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_VALUE:
            raise DataError(
                f"{path}: the time of {quote(name)} is {quote(value)}; expected {BELOW_MAX}: fix it, or write "
                "all times in a larger unit"
            )
    return {name: float(value) for name, value in table.items()}


def add_times(views: list[View], folder: Path) -> list[View]:
    """Return the views with the times in the times.json of `folder`, or the same views without that file.

    Raises DataError like read_times and make_clock, and when the file contains none of the views.
    """
    times = read_times(folder)
    if times is None:
        return views
    clock = make_clock(folder / FILE, [(view.name, times.get(view.name)) for view in views])
    if clock is None:
        raise DataError(f"{folder / FILE}: contains none of the {len(views)} photos; use their relative paths")
    return [replace(view, time=float(clock(times[view.name]))) for view in views]
