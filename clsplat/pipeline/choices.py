"""Make the choices of a pipeline that follow from its photographs, and undo them."""

import copy
import json
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import compress
from typing import Any

from pydantic import ValidationError

from clsplat.core.errors import ConfigError, OverrideError, shortened
from clsplat.pipeline.capture_choice import CaptureChoice, Others, without_choices
from clsplat.pipeline.explanation import first_fault, place_text
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.overrides import apply, split, value_at
from clsplat.pipeline.yaml_file import Place
from clsplat.scene.quality import Measures

# Where the choices of a pipeline file's data are, and where their keys lead.


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


LATE = ("model", "stages")  # parts of a pipeline that are used after the photographs are read


def choose(settings: PipelineFile, measures: Measures) -> PipelineFile:
    """Return the settings with the values that follow from the measures; choices that are made stay.

    Where those of a row do not go together with what `--set` gave for one of them, the file's stay.
    Raises ConfigError where they do not go together either.
    """
    data = settings.model_dump(mode="json")
    before = [[value_at(data, key, PipelineFile) for key in one.keys] for one in settings.choices]

    def made(others: Others) -> PipelineFile:
        pairs = zip(settings.choices, before, strict=True)
        choices = [one if one.reason else one.of(measures, old, others) for one, old in pairs]
        return _with(settings, choices, [pair for one in choices for pair in one.settings])

    what = f"at {', '.join(f'{value:,.4g} {measure}' for measure, value in measures.items())}"
    try:
        return _checked(lambda: made("row"), what)
    except ConfigError:
        if not any(one.given and not one.reason for one in settings.choices):
            raise
        return _checked(lambda: made("file"), what)


def _checked(made: Callable[[], PipelineFile], what: str) -> PipelineFile:
    """Settings that go together.  Raises ConfigError; what: what they are made of."""
    try:
        settings = made()
        for stage in settings.stages:
            stage.check_with(settings)
    except ValidationError as error:
        place, complaint = first_fault(error, PipelineFile)
        raise ConfigError(f"choices, {what}: {place_text(place)}: {complaint}") from error
    except ConfigError as error:
        raise ConfigError(f"choices, {what}: {error}") from error
    return settings


def as_asked(settings: PipelineFile) -> PipelineFile:
    """Return the settings with what `--set` gave for keys of choices, and nothing that follows from photographs.

    Where that does not go together without what follows, they are as they were.
    """
    try:
        return choose(settings, {}) if any(one.given for one in settings.choices) else settings
    except ConfigError:
        return settings


def undone(settings: PipelineFile) -> PipelineFile:
    """Return the settings as they were before a run chose by `choices`.

    Raises ConfigError where what stood there does not fit its place, as after an edit.
    """
    made = [one for one in settings.choices if one.reason]
    before = [pair for one in made for pair in zip(one.keys, one.instead_of or [], strict=True)]
    if not made:
        return settings
    return _checked(lambda: _with(settings, [one.undone() for one in settings.choices], before), "instead_of")


def check_choices(settings: PipelineFile) -> None:
    """Raise ConfigError where a choice has no place, where two have the same, or where values do not go together.

    Beside what `--set` gave for one of them, those of one row need to.
    """
    data, places = settings.model_dump(mode="json"), list[Place]()
    for number, key in [(number, key) for number, one in enumerate(settings.choices) for key in one.keys]:
        place, what = place_in(data, key), f"choices[{number}]: {key}"
        if place[0] not in LATE and place != ("scene", "validation"):
            raise ConfigError(f"{what} is used before photographs are measured; expected a key of {' or '.join(LATE)}")
        if any(touch(place, other) for other in places):
            raise ConfigError(f"{what} is chosen twice; expected one choice for each place")
        places.append(place)
    still_open, faults = undone(settings), list[ConfigError]()
    rows = {tuple(zip(one.measures, one.bounds(row), strict=True)) for one in settings.choices for row in one.values}
    for row in sorted(rows):
        try:
            choose(still_open, dict(row))
        except ConfigError as error:
            faults.append(error)
    if faults and (len(faults) == len(rows) or not any(one.given for one in settings.choices)):
        raise faults[0]


def _with(settings: PipelineFile, choices: Sequence[CaptureChoice], values: Sequence[tuple[str, Any]]) -> PipelineFile:
    data = settings.model_dump(mode="json")
    for key, value in values:
        set_at(data, key, value)
    return PipelineFile.model_validate({**data, "choices": [one.model_dump(mode="json") for one in choices]})


# What overrides do to the data of a pipeline file with choices: `--set` of a key wins over what would be chosen.


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
