"""What overrides do to the data of a pipeline file with choices: `--set` of a key wins over what would be chosen."""

import copy
from collections.abc import Collection, Sequence
from itertools import compress
from typing import Any

from clsplat.pipeline.choice_places import choices_in, place_in, set_at, touch
from clsplat.pipeline.choices import without_choices
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.overrides import apply, split, value_at
from clsplat.pipeline.yaml_file import Place


def overridden(tagged: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a file's data with overrides, also in its choices; with other photographs what a run chose is forgotten.

    Raises OverrideError.
    """
    if any(_is_of_photographs(override) for override in overrides):
        tagged = forgotten(tagged)
    data, places = _applied(tagged, overrides)
    chosen = held(data, places)
    if not chosen:
        return without_overridden(data, places)
    less, _ = _applied(tagged, [one for one, place in zip(overrides, places, strict=True) if place not in chosen])
    for number, key in chosen.values():
        choice, value = less["choices"][number], value_at(data, key, PipelineFile)
        choice["given"] = {**choice.get("given", {}), key: value}
        if isinstance(chosen_values := choice.get("chosen"), list):  # by a run
            pairs = zip(choice["keys"], chosen_values, strict=False)
            choice["chosen"] = [value if one == key else old for one, old in pairs]
            set_at(less, key, value)
    return without_overridden(less, [place for place in places if place not in chosen])


def held(data: dict[str, Any], places: Sequence[Place]) -> dict[Place, tuple[int, str]]:
    """Return those places of overrides that are one of several keys of a choice, with its number and the key.

    It has the value in the place of its rows', so that the file's need not go together with it.
    """
    found: dict[Place, tuple[int, str]] = {}
    for number, choice in choices_in(data):
        if len(choice["keys"]) < 2:
            continue
        for key in choice["keys"]:
            own = place_in(data, key)
            if {place for place in places if touch(place, own)} == {own}:
                found[own] = number, key
    return found


def forgotten(data: dict[str, Any]) -> dict[str, Any]:
    """Return a file's data as they were before a run chose for its own photographs, by `choices` and keys `auto`."""
    data, before = copy.deepcopy(data), list[tuple[str, Any]]()
    for _, choice in choices_in(data):
        made = [choice.pop(name, None) for name in ("reason", "chosen", "instead_of")]
        if made[0] and isinstance(made[2], list):
            before += zip(choice["keys"], made[2], strict=False)
    for key, value in before:
        set_at(data, key, value)
    return dict(without_choices(data))


def without_overridden(data: dict[str, Any], places: Collection[Place]) -> dict[str, Any]:
    """Return a file's data with choices without the keys that an override has set, around them or inside of them."""
    if not places or not isinstance(choices := data.get("choices"), list):
        return data
    left = list(choices)
    for number, choice in choices_in(data):
        own = [place_in(data, key) for key in choice["keys"]]
        kept = [not any(touch(one, place) for place in places) for one in own]
        if not all(kept):
            left[number] = _columns(choice, kept)
    return {**data, "choices": [one for one in left if one is not None]}


def _is_of_photographs(override: str) -> bool:
    """Whether an override sets which photographs are trained with, by which a run may have chosen."""
    names, _ = split(override)
    return names[0] == "scene" and names[1:2] != ["validation"]


def _applied(tagged: dict[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], list[Place]]:
    """A file's data with overrides at their places, and these."""
    data = copy.deepcopy(tagged)
    return data, [apply(data, override, PipelineFile) for override in overrides]


def _columns(choice: dict[str, Any], kept: list[bool]) -> dict[str, Any] | None:
    """A choice of some of its keys; None of none."""
    own = {name: choice[name] for name in ("keys", "chosen", "instead_of") if isinstance(choice.get(name), list)}
    rows = [[row[0], *compress(row[1:], kept)] for row in choice["values"]]
    less = {**choice, **{name: list(compress(values, kept)) for name, values in own.items()}, "values": rows}
    if given := choice.get("given"):
        less["given"] = {key: value for key, value in given.items() if key in less["keys"]}
    return less if any(kept) else None
