"""The keys of a pipeline that `--set` can change, in the notation of `--set`."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from clsplat.errors import ConfigError
from clsplat.pipeline.overrides import NOT_SETTABLE
from clsplat.pipeline.yaml_file import parse_value
from clsplat.settings import descriptions

CADENCE = ("every", "start", "stop")  # keys of stages inside `during` only


@dataclass(frozen=True)
class Key:
    """One setting."""

    place: str  # in the notation of --set, such as optimize.losses.0.weight
    value: Any  # plain data
    description: str

    @property
    def text(self) -> str:
        """'place=value', in the notation of --set."""
        return f"{self.place}={value_text(self.value)}"


def settable(settings: BaseModel) -> list[Key]:
    """List every key of checked settings, in their order."""
    return list(_keys(settings, "", _addresses(settings)))


def _keys(model: BaseModel, prefix: str, addresses: dict[int, str]) -> Iterator[Key]:
    plain = model.model_dump(mode="json")
    outside = hasattr(model, "every") and model.every is None
    fields, texts = type(model).model_fields, descriptions(type(model))
    for name in sorted(fields, key=lambda name: name != "type"):
        value = getattr(model, name)
        if name in ("stage", *NOT_SETTABLE) or (outside and name in CADENCE):
            continue
        items = value if isinstance(value, list) and value and isinstance(value[0], BaseModel) else None
        if isinstance(value, BaseModel):
            yield from _keys(value, f"{prefix}{name}.", addresses)
        elif items is not None:
            for i, item in enumerate(items):
                yield from _keys(item, addresses.get(id(item), f"{prefix}{name}.{i}") + ".", addresses)
        else:
            yield Key(prefix + name, plain.get(name), texts.get(name, ""))


def _addresses(settings: BaseModel) -> dict[int, str]:
    """The shortest place of every stage, by its id: its name, the name below that of its stage, or its number."""
    outer = list(_stages(settings))
    names = [stage.stage for _, stage in outer]
    inner = [(i, list(_stages(stage))) for i, (_, stage) in enumerate(outer)]
    inner_names = [stage.stage for _, stages in inner for _, stage in stages]
    addresses = {
        id(stage): stage.stage if names.count(stage.stage) == 1 else place for place, stage in outer
    }  # fmt: skip
    for i, stages in inner:
        own = [stage.stage for _, stage in stages]
        around = addresses[id(outer[i][1])]
        for place, stage in stages:
            if stage.stage not in names and inner_names.count(stage.stage) == 1:
                addresses[id(stage)] = stage.stage
            elif own.count(stage.stage) == 1:
                addresses[id(stage)] = f"{around}.{stage.stage}"
            else:
                addresses[id(stage)] = f"{around}.{place}"
    return addresses


def _stages(model: BaseModel) -> Iterator[tuple[str, Any]]:
    """The stages in the lists of a model, each with its place there."""
    for name in type(model).model_fields:
        value = getattr(model, name)
        for i, item in enumerate(value if isinstance(value, list) else []):
            if hasattr(item, "stage"):
                yield f"{name}.{i}", item


def value_text(value: Any) -> str:
    """Return a value in the notation of --set, with as few quotes as possible."""
    text = f"[{','.join(map(value_text, value))}]" if isinstance(value, list) else str(value)
    try:
        return text if parse_value(text) == value and not isinstance(value, bool) else json.dumps(value)
    except ConfigError:
        return json.dumps(value, ensure_ascii=False)
