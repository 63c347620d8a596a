"""Short names for the values of a matrix, from which those of its cells are made."""

import json
from collections.abc import Sequence
from typing import Any


def distinct(paths: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the shortest ends of the paths that differ from each other."""
    for length in range(1, max((len(parts) for parts in paths), default=0) + 1):
        names = ["-".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return ["-".join(parts) for parts in paths]


def value_text(value: Any) -> str:
    """Return a value as a part of a name."""
    if isinstance(value, list):
        return "+".join(value_text(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value)
