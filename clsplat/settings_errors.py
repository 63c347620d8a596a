"""Turning a failed validation into one sentence: file, line, place, what was expected, the nearest match."""

import difflib
import re
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from clsplat.settings import Settings, Variants, variants
from clsplat.yaml_file import Document, Place

EXPECTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
}


def explain(error: ValidationError, root: type[BaseModel], path: Path, document: Document) -> str:
    """Describe the first thing that is wrong; a misspelt key explains the one that is missing, so it goes first."""
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    place, model, annotation = _follow(first["loc"], root)
    return f"{path}:{document.line(place)}: {_text(place)}: {_complaint(dict(first), place, model, annotation)}"


def _complaint(error: dict[str, Any], place: Place, model: type[BaseModel] | None, annotation: Any) -> str:
    kind, value = error["type"], error["input"]
    if kind == "extra_forbidden":
        known = [name for name in (model.model_fields if model else {}) if name not in ("stage", "type")]
        return f"unknown key '{place[-1]}'{_nearest(str(place[-1]), known)}"
    if kind == "missing":
        return f"'{place[-1]}' is missing"
    if kind == "union_tag_invalid":
        tags = [tag.strip().strip("'") for tag in error["ctx"]["expected_tags"].split(",")]
        return f"no {_kind(annotation)} named '{error['ctx']['tag']}'{_nearest(error['ctx']['tag'], tags)}"
    if kind == "union_tag_not_found":
        return f"expected a 'type', the name of the {_kind(annotation)}"
    if kind == "literal_error":
        return f"expected {error['ctx']['expected']}, got {value!r}"
    if kind in EXPECTED:
        return f"expected {EXPECTED[kind]}, got {value!r}"
    message = error["msg"].removeprefix("Value error, ")
    return f"{message[:1].lower()}{message[1:]}, got {value!r}" if not isinstance(value, dict | list) else message


def _nearest(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(sorted(known))}"


def _kind(annotation: Any) -> str:
    """What a field chooses from, in words: 'world filter' for variants of WorldFilter, 'stage' for those of Stage."""
    base = _bases(annotation)[0]
    family = base.__mro__[base.__mro__.index(Settings) - 1]
    return re.sub(r"(?<=\w)(?=[A-Z])", " ", family.__name__).lower()


def _text(place: Place) -> str:
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _follow(location: tuple[int | str, ...], root: type[BaseModel]) -> tuple[Place, type[BaseModel] | None, Any]:
    """Translate a location among models, which names union members, into the file's; also the model around it, and the
    annotation there.

    In the file a stage's name is a key of its own (stages[1].optimize.steps); a strategy's type is not.
    """
    place: list[str | int] = []
    annotation: Any = root
    model: type[BaseModel] | None = root
    for part in location:
        members = _models(annotation)
        tagged = [m for m in members if part in _tags(m)]
        if isinstance(part, int):
            place.append(part)
            annotation = _inside_list(annotation)
        elif tagged and not (len(members) == 1 and part in members[0].model_fields):
            annotation = model = tagged[0]
            if "stage" in model.model_fields:
                place.append(part)
        else:
            place.append(part)
            model = members[0] if len(members) == 1 else model
            field = model.model_fields.get(part) if model else None
            annotation = _annotation(field) if field else None
    return tuple(place), model, annotation


def _annotation(field: FieldInfo) -> Any:
    """A field's annotation with its marks, as it was written."""
    return typing.Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models that an annotation allows directly."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if typing.get_origin(annotation) is typing.Annotated:
        bases = _bases(annotation)
        return list(variants(bases[0]).values()) if bases else _models(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [model for argument in typing.get_args(annotation) for model in _models(argument)]
    return []


def _bases(annotation: Any) -> list[type[Settings]]:
    """The base whose variants a field takes, if it does."""
    if typing.get_origin(annotation) is not typing.Annotated:
        return []
    return [mark.base for mark in typing.get_args(annotation)[1:] if isinstance(mark, Variants)]


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    field = model.model_fields.get("stage") or model.model_fields.get("type")
    return typing.get_args(field.annotation) if field else ()


def _inside_list(annotation: Any) -> Any:
    if typing.get_origin(annotation) is typing.Annotated:
        return _inside_list(typing.get_args(annotation)[0])
    return next(iter(typing.get_args(annotation)), None)
