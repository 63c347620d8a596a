"""Explain a failed validation in one sentence: the file, line, and key, what is expected, and the nearest match."""

import difflib
import re
import types
import typing
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from clsplat.core.errors import quote, shorten
from clsplat.core.settings import TAGS, Settings, Variants, variants
from clsplat.pipeline.yaml_file import Document, KeyPath

# Read the annotations of settings: the models that a field allows, and their names.


def models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation allows directly."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if typing.get_origin(annotation) is typing.Annotated:
        base = bases(annotation)
        return list(variants(base[0]).values()) if base else models(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [model for argument in typing.get_args(annotation) for model in models(argument)]
    return []


def bases(annotation: Any) -> list[type[Settings]]:
    """Return the base classes of the variants that a field accepts; an empty list if it accepts none."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [base for argument in typing.get_args(annotation) for base in bases(argument)]
    if typing.get_origin(annotation) is not typing.Annotated:
        return []
    return [mark.base for mark in typing.get_args(annotation)[1:] if isinstance(mark, Variants)]


def is_union(annotation: Any) -> bool:
    """Return whether an annotation allows several types, not counting null."""
    members = typing.get_args(annotation) if typing.get_origin(annotation) in (typing.Union, types.UnionType) else ()
    return len([member for member in members if member is not types.NoneType]) > 1


def field_annotation(field: FieldInfo) -> Any:
    """Return a field's annotation with its metadata, as it was written."""
    return typing.Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


@lru_cache(maxsize=1024)
def annotations(model: type[BaseModel]) -> dict[str, Any]:
    """Return the type annotations of the fields of a settings class, with their metadata, by field name."""
    return {name: field_annotation(field) for name, field in model.model_fields.items()}


@lru_cache(maxsize=1024)
def tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """Return the names of a model in pipeline files; an empty tuple if it is not a variant."""
    field = next((model.model_fields[name] for name in TAGS if name in model.model_fields), None)
    return typing.get_args(field.annotation) if field else ()


def item_annotation(annotation: Any) -> Any:
    """Return the annotation of a list's items."""
    if typing.get_origin(annotation) is typing.Annotated:
        return item_annotation(typing.get_args(annotation)[0])
    return next(iter(typing.get_args(annotation)), None)


def find_model(data: Any, annotation: Any) -> type[BaseModel] | None:
    """Return the model that the tag in plain data selects, or None if the tag is unknown."""
    candidates = models(annotation)
    if len(candidates) > 1 and isinstance(data, dict):
        names = [data[name] for name in TAGS if name in data]
        candidates = [model for model in candidates for name in names if name in tags(model)]
    return candidates[0] if len(candidates) == 1 else None


def with_tags(data: Any, annotation: Any) -> Any:
    """Return plain data with each name of a variant as {type: name}, and each stage as {stage: name, key: value, …}."""
    if not isinstance(data, list | dict | str):
        return data
    if isinstance(data, list):
        return [with_tags(item, item_annotation(annotation)) for item in data]
    for mark in map(Variants, bases(annotation)):
        if isinstance(data, str):
            data = {mark.tag: data}
        elif mark.tag == "stage" and isinstance(data, dict) and len(data) == 1:
            name, fields = next(iter(data.items()))
            if name != "stage" and isinstance(fields, dict | None):
                data = {"stage": name, **(fields or {})}
    if isinstance(data, dict) and (model := find_model(data, annotation)):
        by_key = annotations(model)
        return {key: with_tags(value, by_key.get(key)) for key, value in data.items()}
    return data


EXPECTATIONS = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "literal_error": "{expected}",
    "greater_than": "a value greater than {gt}",
    "greater_than_equal": "a value of at least {ge}",
    "less_than": "a value less than {lt}",
    "less_than_equal": "a value of at most {le}",
    "finite_number": "a finite number",
    "too_short": "a list of at least {min_length} items",
    "too_long": "a list of at most {max_length} items",
    "string_pattern_mismatch": "text that matches {pattern}",
}


def explain(error: ValidationError, root: type[BaseModel], path: Path, document: Document) -> str:
    """Return a message about the first fault, with its file, line, and key."""
    key_path, message = first_fault(error, root)
    prefix = f"{key_path_text(key_path)}: " if key_path else ""  # "": a fault of the entire file
    return f"{path}:{document.line(key_path)}: {prefix}{message}"


def first_fault(error: ValidationError, root: type[BaseModel]) -> tuple[KeyPath, str]:
    """Return the key path and a description of the first fault.

    A misspelled key is reported before a missing key, because the misspelling is often why a key is missing.
    """
    first = min(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
    key_path, model, annotation = _follow(first["loc"], root)
    return key_path, _describe_error(dict(first), key_path, model, annotation)


def _describe_error(error: dict[str, Any], key_path: KeyPath, model: type[BaseModel] | None, annotation: Any) -> str:
    error_type, value = error["type"], error["input"]
    if error_type == "extra_forbidden":
        if advice := getattr(model, "unavailable", {}).get(key_path[-1]):
            return str(advice)
        keys = [name for name in (model.model_fields if model else {}) if name not in TAGS]
        return f"unknown key {quote(key_path[-1])}{_nearest(str(key_path[-1]), keys)}"
    if error_type == "missing":
        return f"'{key_path[-1]}' is missing"
    if error_type == "union_tag_invalid":
        names = [tag.strip().strip("'") for tag in error["ctx"]["expected_tags"].split(",")]
        tag = shorten(str(error["ctx"]["tag"]))
        return f"no {_describe_kind(annotation)} named '{tag}'{_nearest(tag, names)}; plug-ins need --plugin FILE.py"
    if error_type == "union_tag_not_found":
        tag = Variants(bases(annotation)[0]).tag
        return f"expected a '{tag}', the name of the {_describe_kind(annotation)}"
    suffix = f", got {quote(value)}"
    if error_type in EXPECTATIONS:
        return f"expected {EXPECTATIONS[error_type].format(**error.get('ctx', {}))}{suffix}"
    message = error["msg"].removeprefix("Value error, ")
    message = f"{message[:1].lower()}{message[1:]}"
    return message if isinstance(value, dict | list) else message + suffix


def _nearest(name: str, names: list[str]) -> str:
    """Return a hint with the name that is most similar to an unknown name, or with a list of all names."""
    matches = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if matches:
        return f"; did you mean '{matches[0]}'?"
    return f"; expected one of {', '.join(sorted(names))}" if names else "; remove it: no keys are allowed here"


def _describe_kind(annotation: Any) -> str:
    """Return the name of a field's base class as words, such as 'world filter' for variants of WorldFilter."""
    base = bases(annotation)[0]
    family = base.__mro__[base.__mro__.index(Settings) - 1]
    return re.sub(r"(?<=\w)(?=[A-Z])", " ", family.__name__).lower()


def key_path_text(key_path: KeyPath) -> str:
    """Return a key path as text, such as stages[1].optimize.steps."""
    text = ""
    for part in key_path:
        name = shorten(str(part))
        text += f"[{part}]" if isinstance(part, int) else f".{name}" if text else name
    return text


def _follow(location: tuple[int | str, ...], root: type[BaseModel]) -> tuple[KeyPath, type[BaseModel] | None, Any]:
    """Translate pydantic's location, which includes the names of union members, into a key path of the file.

    Also return the model that contains the key, and the key's annotation.  In the file, the name of a stage is a key
    (stages[1].optimize.steps), while the type of a loss or rule is not.
    """
    key_path: list[str | int] = []
    annotation: Any = root
    model: type[BaseModel] | None = root
    for part in location:
        members = models(annotation)
        matches = [member for member in members if part in tags(member)]
        if isinstance(part, int):
            key_path.append(part)
            annotation = item_annotation(annotation)
        elif matches and not (len(members) == 1 and part in members[0].model_fields):
            annotation = model = matches[0]
            if "stage" in model.model_fields:
                key_path.append(part)
        elif not members and is_union(annotation):
            annotation = None  # the part names a member of the union
        else:
            key_path.append(part)
            model = members[0] if len(members) == 1 else model
            field = model.model_fields.get(part) if model else None
            annotation = field_annotation(field) if field else None
    return tuple(key_path), model, annotation
