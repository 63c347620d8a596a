"""Where the choices of a pipeline file's data are, and where their keys lead."""

import copy
import json
from collections.abc import Iterator
from typing import Any

from clsplat.errors import ConfigError, OverrideError, shortened
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.overrides import apply
from clsplat.pipeline.yaml_file import Place


def choices_in(data: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the choices of a file's data that have the shape of one, with their numbers."""
    choices = data.get("choices")
    for number, one in enumerate(choices if isinstance(choices, list) else ()):
        keys, rows = (one.get("keys"), one.get("values")) if isinstance(one, dict) else (None, None)
        if not isinstance(keys, list) or not isinstance(rows, list) or not isinstance(one.get("given", {}), dict):
            continue
        if all(isinstance(key, str) for key in keys) and all(isinstance(row, list) and row for row in rows):
            yield number, one


def set_at(data: dict[str, Any], key: str, value: Any) -> Place:
    """Set a key of a choice in a file's data; return its place.  Raises OverrideError where there is none."""
    return apply(data, f"{key}={json.dumps(value)}", PipelineFile)


def place_in(data: dict[str, Any], key: str) -> Place:
    """Return the place of a key of a choice in a file's data.  Raises ConfigError where there is none."""
    try:
        return set_at(copy.deepcopy(data), key, None)
    except OverrideError as error:
        raise ConfigError(f"choices: {shortened(key)}: {error.reason}") from error


def touch(one: Place, other: Place) -> bool:
    """Return whether one of two places is the other, or holds it."""
    shorter = min(len(one), len(other))
    return shorter > 0 and one[:shorter] == other[:shorter]
