"""Make the choices of a pipeline that follow from its photographs, and undo them."""

import copy
import json
from collections.abc import Collection, Sequence
from typing import Any

from pydantic import ValidationError

from clsplat.errors import ConfigError
from clsplat.pipeline.choices import CaptureChoice
from clsplat.pipeline.explanation import first_fault, place_text
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.overrides import apply, value_at
from clsplat.pipeline.yaml_file import Place
from clsplat.scene.capture import Measure

LATE = ("model", "stages")  # parts of a pipeline that are used after the photographs are read


def choose(settings: PipelineFile, measures: dict[Measure, float]) -> PipelineFile:
    """Return the settings with the values that follow from the measures; choices that are made stay.

    Raises ConfigError where they do not go together.
    """
    data = settings.model_dump(mode="json")

    def made(one: CaptureChoice) -> CaptureChoice:
        return one if one.reason else one.of(measures, [value_at(data, key, PipelineFile) for key in one.keys])

    choices = [made(one) for one in settings.choices]
    try:
        return _with(settings, choices, [pair for one in choices for pair in one.settings])
    except ValidationError as error:
        place, complaint = first_fault(error, PipelineFile)
        measured = ", ".join(f"{value:,.4g} {measure}" for measure, value in measures.items())
        raise ConfigError(f"choices, at {measured}: {place_text(place)}: {complaint}") from error


def undone(settings: PipelineFile) -> PipelineFile:
    """Return the settings as they were before a run chose by `choices`."""
    made = [one for one in settings.choices if one.reason]
    before = [pair for one in made for pair in zip(one.keys, one.instead_of or [], strict=True)]
    return _with(settings, [one.undone() for one in settings.choices], before) if made else settings


def without_overridden(data: dict[str, Any], places: Collection[Place]) -> dict[str, Any]:
    """Return a file's data without the choices of what an override has set, around it or inside of it."""
    if not places or not isinstance(choices := data.get("choices"), list):
        return data

    def is_set(choice: Any) -> bool:
        keys = choice.get("keys") if isinstance(choice, dict) else None
        own = [_place(data, key) for key in keys if isinstance(key, str)] if isinstance(keys, list) else []
        return any(_touch(one, place) for one in own for place in places)

    return {**data, "choices": [one for one in choices if not is_set(one)]}


def check_choices(settings: PipelineFile) -> None:
    """Raise ConfigError where a choice has no place, where two have the same, or where values do not go together."""
    data, places = settings.model_dump(mode="json"), list[Place]()
    for number, key in [(number, key) for number, one in enumerate(settings.choices) for key in one.keys]:
        place, what = _place(data, key), f"choices[{number}]: {key}"
        if place[0] not in LATE and place != ("scene", "validation"):
            raise ConfigError(f"{what} is used before photographs are measured; expected a key of {' or '.join(LATE)}")
        if any(_touch(place, other) for other in places):
            raise ConfigError(f"{what} is chosen twice; expected one choice for each place")
        places.append(place)
    still_open = undone(settings)
    for by, bound in sorted({(one.by, bound) for one in settings.choices for bound, *_ in one.values}):
        choose(still_open, {by: bound})


def _with(settings: PipelineFile, choices: Sequence[CaptureChoice], values: Sequence[tuple[str, Any]]) -> PipelineFile:
    data = settings.model_dump(mode="json")
    for key, value in values:
        _set(data, key, value)
    return PipelineFile.model_validate({**data, "choices": [one.model_dump(mode="json") for one in choices]})


def _set(data: dict[str, Any], key: str, value: Any) -> Place:
    return apply(data, f"{key}={json.dumps(value)}", PipelineFile)


def _place(data: dict[str, Any], key: str) -> Place:
    """The place of a key in a file's data.  Raises OverrideError where there is none."""
    return _set(copy.deepcopy(data), key, None)


def _touch(one: Place, other: Place) -> bool:
    """Whether one of two places is the other, or holds it."""
    shorter = min(len(one), len(other))
    return shorter > 0 and one[:shorter] == other[:shorter]
