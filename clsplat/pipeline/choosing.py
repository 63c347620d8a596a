"""Make the choices of a pipeline that follow from its photographs, and undo them."""

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import ValidationError

from clsplat.errors import ConfigError
from clsplat.pipeline.choice_places import place_in, set_at, touch
from clsplat.pipeline.choices import CaptureChoice, Others
from clsplat.pipeline.explanation import first_fault, place_text
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.keeping import check_keeping
from clsplat.pipeline.overrides import value_at
from clsplat.pipeline.yaml_file import Place
from clsplat.scene.capture import Measures

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
        check_keeping(settings)
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
