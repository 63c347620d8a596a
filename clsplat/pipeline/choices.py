"""What a run writes into its pipeline file of what it chose by its photographs: `chosen`, and the `reason`."""

from typing import Any

WRITTEN = ("chosen", "reason")  # keys of a choice


def without_choices(data: Any) -> Any:
    """Return plain data of a resolved pipeline as it was before a run chose."""
    if isinstance(data, list):
        return [without_choices(item) for item in data]
    if not isinstance(data, dict):
        return data
    chooses = all(key in data for key in WRITTEN)
    return {key: without_choices(value) for key, value in data.items() if not (chooses and key in WRITTEN)}
