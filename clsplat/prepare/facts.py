"""What the steps of `prepare` have found, as their records tell."""

from collections.abc import Sequence
from typing import Any

from clsplat.prepare.cache import Planned, record_of

INTERNAL = ("origin", "inputs", "settings", "files")  # keys of a record that are not what a step has found


def facts(planned: Sequence[Planned]) -> dict[str, dict[str, Any]]:
    """Return what each step has found, by its name; steps whose results were removed are left out."""
    records = {one.step.stage: record_of(one.folder) for one in planned}
    return {
        stage: {key: value for key, value in record.items() if key not in INTERNAL}
        for stage, record in records.items()
        if record
    }
