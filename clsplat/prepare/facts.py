"""What the steps of `prepare` have found, as their records tell."""

from collections.abc import Sequence
from typing import Any

from clsplat.errors import DataError
from clsplat.prepare.cache import RECORD, Planned
from clsplat.reading import read_json

INTERNAL = ("origin", "inputs", "settings")  # keys of a record that identify a result


def facts(planned: Sequence[Planned]) -> dict[str, dict[str, Any]]:
    """Return what each step has found, by its name; steps whose results were removed are left out."""
    found = {}
    for one in planned:
        try:
            record = read_json(one.folder / RECORD)
        except DataError:
            continue
        if isinstance(record, dict):
            found[one.step.stage] = {key: value for key, value in record.items() if key not in INTERNAL}
    return found
