"""The settings in which resolved pipelines differ."""

import json
from collections.abc import Sequence
from typing import Any


def flat(settings: dict[str, Any]) -> dict[str, str]:
    """Return place -> value as text, in the order of the file.

    A stage's place is its name and a strategy's its type, so that pipelines with different stages can be compared:
    `optimize.densify.clone.gradient_above`.  The second item of a name has `#2`.
    """
    found: dict[str, str] = {}
    for key, value in settings.items():
        _add(found, "" if key == "stages" else str(key), value)
    return found


def differing(settings: Sequence[dict[str, str]]) -> list[str]:
    """Return the places whose values differ between flat settings, in order of their first occurrence."""
    places = list(dict.fromkeys(place for one in settings for place in one))
    return [place for place in places if len({one.get(place) for one in settings}) > 1]


def _add(found: dict[str, str], place: str, value: Any) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            _add(found, _joined(place, str(key)), inner)
        if not value:
            found[place] = "yes"
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        names: dict[str, int] = {}
        for item in value:
            name, inner = _named(item)
            names[name] = names.get(name, 0) + 1
            label = name if names[name] == 1 else f"{name}#{names[name]}"
            parent = place.removesuffix("during").removesuffix("rules").removesuffix("losses").rstrip(".")
            _add(found, _joined(parent, label), inner)
    else:
        found[place] = value if isinstance(value, str) else json.dumps(value)


def _named(item: Any) -> tuple[str, Any]:
    """The name of a list's item, and the item without it."""
    if isinstance(item, dict) and "type" in item:
        return str(item["type"]), {key: value for key, value in item.items() if key != "type"}
    if isinstance(item, dict) and len(item) == 1:
        return next(iter(item.items()))
    return (str(item), {}) if not isinstance(item, dict) else ("item", item)


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name
