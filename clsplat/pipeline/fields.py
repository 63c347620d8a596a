"""Read the annotations of settings: the models that a field allows, and their names."""

import types
import typing
from functools import lru_cache
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from clsplat.settings import TAGS, Settings, Variants, variants


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
    """Return the base of the variants that a field accepts, also of one that may be null, in a list; without variants
    the list is empty."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [base for argument in typing.get_args(annotation) for base in bases(argument)]
    if typing.get_origin(annotation) is not typing.Annotated:
        return []
    return [mark.base for mark in typing.get_args(annotation)[1:] if isinstance(mark, Variants)]


def is_union(annotation: Any) -> bool:
    """Return whether an annotation allows several types beside null."""
    is_one = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return is_one and len([one for one in typing.get_args(annotation) if one is not types.NoneType]) > 1


def annotation_of(field: FieldInfo) -> Any:
    """Return a field's annotation with its marks, as it was written."""
    return typing.Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


@lru_cache(maxsize=1024)
def annotations(model: type[BaseModel]) -> dict[str, Any]:
    """Return the annotations of a model's fields, with their marks, by name."""
    return {name: annotation_of(field) for name, field in model.model_fields.items()}


@lru_cache(maxsize=1024)
def tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """Return the names of the model in pipeline files; none when it is not a variant."""
    field = next((model.model_fields[name] for name in TAGS if name in model.model_fields), None)
    return typing.get_args(field.annotation) if field else ()


def inside_list(annotation: Any) -> Any:
    """Return the annotation of a list's items."""
    if typing.get_origin(annotation) is typing.Annotated:
        return inside_list(typing.get_args(annotation)[0])
    return next(iter(typing.get_args(annotation)), None)


def model_of(data: Any, annotation: Any) -> type[BaseModel] | None:
    """Return the model of plain data with its tag; None when it is not known."""
    allowed = models(annotation)
    if len(allowed) > 1 and isinstance(data, dict):
        named = [data[name] for name in TAGS if name in data]
        allowed = [model for model in allowed for name in named if name in tags(model)]
    return allowed[0] if len(allowed) == 1 else None


def with_tags(data: Any, annotation: Any) -> Any:
    """Return plain data with every bare name of a variant as {type: name}, and a stage as {stage: name, …}."""
    if not isinstance(data, list | dict | str):
        return data
    if isinstance(data, list):
        return [with_tags(item, inside_list(annotation)) for item in data]
    for mark in map(Variants, bases(annotation)):
        if isinstance(data, str):
            data = {mark.tag: data}
        elif mark.tag == "stage" and isinstance(data, dict) and len(data) == 1:
            name, fields = next(iter(data.items()))
            if name != "stage" and isinstance(fields, dict | None):
                data = {"stage": name, **(fields or {})}
    if isinstance(data, dict) and (model := model_of(data, annotation)):
        known = annotations(model)
        return {key: with_tags(value, known.get(key)) for key, value in data.items()}
    return data
