"""`--set place=value`: changes to a pipeline file's data before it is checked.

optimize.steps=500              a stage by its name, also one inside `during` if its name is unique
optimize.losses.0.weight=0.5    an item of a list by its number, from 0; losses[0] is the same
optimize.modules.exposure={}    an item of `modules` by its type: added at its place, or changed; null removes it
stages.1.steps=500              a stage by its number, where several have the same name
"""

import difflib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from clsplat.core.errors import ConfigError, OverrideError, quote, shorten
from clsplat.core.settings import TAGS, Variants, descriptions, variants
from clsplat.pipeline.explanation import annotations, bases, inside_list, model_of, with_tags
from clsplat.pipeline.yaml_file import Place, parse_value

MAX_SUGGESTIONS = 3
MAX_PARTS = 32  # of a place; real ones have up to ten
NOT_SETTABLE = {"plugins": "a run writes it; load a plug-in with --plugin FILE"}


class NoSuchKey(OverrideError):
    """A place that the pipeline does not have."""


def split(text: str) -> tuple[list[str], str]:
    """Return the parts of the place, and the value.  Raises OverrideError."""
    place, equals, value = text.partition("=")
    names = re.findall(r"[^.\[\]]+", place)
    if not equals or not 0 < len(names) <= MAX_PARTS:
        raise OverrideError(text, "expected stage.key=value, for example optimize.steps=500")
    return names, value


def apply(data: dict[str, Any], text: str, root: type[BaseModel]) -> Place:
    """Change the data, in which each stage has its name as `stage`; return the place in the shape of the file.

    Raises OverrideError.
    """
    _, value = split(text)
    try:
        parsed = parse_value(value)
    except ConfigError as error:
        raise OverrideError(text, f"the value cannot be read: {error}") from error
    node, last = _found(data, text, root)
    if isinstance(node.data, list) and node.is_by_type(last):
        node.put(last, parsed, text)
        return (*node.place, last)
    if isinstance(node.data, list):
        i = node.number(last, text)
        node.data[i] = with_tags(parsed, node.inside)
        return (*node.place, i)
    if not isinstance(node.data, dict):
        raise NoSuchKey(text, f"nothing lies below {quote(node.place[-1])}")
    if not node.place and last not in root.model_fields:
        raise NoSuchKey(text, f"no key {quote(last)} at the top of a pipeline")
    node.data[last] = with_tags(parsed, node.annotation(last))
    return (*node.place, last)


def _found(data: dict[str, Any], text: str, root: type[BaseModel]) -> "tuple[_Node, str]":
    """What holds the key of 'place=value', and the key's name in it.  Raises OverrideError."""
    names, _ = split(text)
    if names[0] in NOT_SETTABLE:
        raise OverrideError(text, f"'{names[0]}' cannot be set; {NOT_SETTABLE[names[0]]}")
    node = _Node(data, root, ())
    for name in names[:-1]:
        node = node.child(name, text)
    return node, names[-1]


class _Node:
    """A dict or list of the data, with its annotation and its place in the file."""

    def __init__(self, data: Any, annotation: Any, place: Place) -> None:
        self.data = data
        self.place = place
        self.model = model_of(data, annotation)
        self.inside = inside_list(annotation) if isinstance(data, list) else None

    def child(self, name: str, text: str) -> "_Node":
        """Return the node of a key; a missing key is made from its default.  Raises OverrideError."""
        if isinstance(self.data, list) and self.is_by_type(name):
            if all(one["type"] != name for one in self.data):
                self.put(name, {}, text)
            item = next(one for one in self.data if one["type"] == name)
            return _Node(item, self.inside, (*self.place, name))
        if isinstance(self.data, list):
            return self._item(self.number(name, text))
        if not isinstance(self.data, dict):
            raise NoSuchKey(text, f"nothing lies below {quote(self.place[-1])}")
        if stage := self._stage(name, text):
            return stage
        if self.data.get(name) is None:
            if not self.place and name not in self._fields:
                raise NoSuchKey(text, f"no {quote(name)} in this pipeline")
            default = self._fields[name].get_default(call_default_factory=True) if name in self._fields else None
            is_list = isinstance(default, list)
            self.data[name] = _as_written(default) if isinstance(default, BaseModel) else [] if is_list else {}
        return self._key(name)

    def is_by_type(self, name: str) -> bool:
        """Whether the name is a type of items that are addressed by it, and not a number."""
        is_keyed = any(base.keyed_by_type for base in bases(self.inside))
        return is_keyed and not name.isdigit() and all(isinstance(one, dict) and "type" in one for one in self.data)

    def put(self, name: str, value: Any, text: str) -> None:
        """Put an item of a type at its place in a list, or in place of the one that is there; None removes that.

        Raises OverrideError.
        """
        kinds: dict[str, Any] = {key: kind for base in bases(self.inside) for key, kind in variants(base).items()}
        if name not in kinds:
            near = difflib.get_close_matches(name, kinds, n=1)
            meant = f"; did you mean {near[0]}?" if near else ""
            raise OverrideError(text, f"no {quote(name)}; expected one of {', '.join(kinds)}{meant}")
        if value is not None and not isinstance(value, dict):
            raise OverrideError(text, "expected a mapping of its keys, such as {}, or null")
        places = [one["type"] for one in self.data]
        at = places.index(name) if name in places else None
        if at is not None:
            del self.data[at]
        if value is None:
            return
        if at is None:
            at = sum(getattr(kinds.get(one), "order", 0) <= kinds[name].order for one in places)
        item = {"type": name, **{key: one for key, one in value.items() if key != "type"}}
        self.data.insert(at, with_tags(item, self.inside))

    def number(self, name: str, text: str) -> int:
        """Return the index that a name holds.  Raises OverrideError."""
        if re.fullmatch(r"[0-9]{1,9}", name) and int(name) < len(self.data):
            return int(name)
        count = len(self.data)
        raise NoSuchKey(text, f"expected a number below {count} in a list of {count}, got {quote(name)}")

    @property
    def _fields(self) -> dict[str, Any]:
        return dict(self.model.model_fields) if self.model else {}

    def annotation(self, name: str) -> Any:
        """Return the annotation of a key; None where it is not known."""
        return annotations(self.model).get(name) if self.model else None

    def _key(self, name: str) -> "_Node":
        annotation = self.annotation(name)
        self.data[name] = with_tags(self.data[name], annotation)  # nothing can be set below a bare name
        return _Node(self.data[name], annotation, (*self.place, name))

    def _item(self, i: int) -> "_Node":
        item = self.data[i]
        name = [item["stage"]] if isinstance(item, dict) and "stage" in item else []
        return _Node(item, self.inside, (*self.place, i, *name))

    def _stages(self) -> "list[_Node]":
        """The stages in the lists of a map."""
        lists = [self._key(key) for key, value in self.data.items() if isinstance(value, list) and self._may_hold(key)]
        items = [node._item(i) for node in lists for i in range(len(node.data))]
        return [item for item in items if isinstance(item.data, dict) and "stage" in item.data]

    def _may_hold(self, key: str) -> bool:
        """Whether a list may have stages in it: it is not known to be of other things."""
        kinds = bases(inside_list(self.annotation(key)))
        return self.annotation(key) is None or any(Variants(kind).tag == "stage" for kind in kinds)

    def _stage(self, name: str, text: str) -> "_Node | None":
        """The stage of that name, here or from the top inside another.  Raises OverrideError where several have it."""
        own = self._stages()
        found = [node for node in own if node.data["stage"] == name]
        if not found and not self.place:
            found = [inner for node in own for inner in node._stages() if inner.data["stage"] == name]
        if len(found) > 1:
            numbers = shorten(" or ".join(_address(node.place) for node in found), 200)
            raise OverrideError(text, f"there are {len(found)} stages named {quote(name)}; write {numbers} for it")
        return found[0] if found else None


def _as_written(default: BaseModel) -> dict[str, Any]:
    """A default as in a file: its tag, and the keys that differ from their own defaults."""
    written = default.model_dump(mode="json", exclude_defaults=True)
    return {**{name: getattr(default, name) for name in TAGS if hasattr(default, name)}, **written}


def _address(place: Place) -> str:
    """A stage's place with numbers alone, without the names of stages."""
    return ".".join(str(part) for i, part in enumerate(place) if not (i and isinstance(place[i - 1], int)))


def suggestion(names: Sequence[str], known: Sequence[str]) -> str:
    """Return '; did you mean …?' with the known places that end with `names` or are similar; '' without any."""
    place = ".".join(names)
    near = [one for one in known if one.endswith(f".{place}")]
    near = near or difflib.get_close_matches(place, known, n=1)
    near = near or [one for one in known if one.rpartition(".")[2] == names[-1]]
    if not near:
        last = difflib.get_close_matches(names[-1], [one.rpartition(".")[2] for one in known], n=1)
        near = [one for one in known if one.rpartition(".")[2] in last]
    return f"; did you mean {' or '.join(near[:MAX_SUGGESTIONS])}?" if near else ""


# The keys of a pipeline that `--set` can change, in the notation of `--set`.

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
                own = item.type if getattr(item, "keyed_by_type", False) else i
                yield from _keys(item, addresses.get(id(item), f"{prefix}{name}.{own}") + ".", addresses)
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
