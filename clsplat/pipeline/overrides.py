"""Apply `--set KEY=VALUE` to a pipeline file's data before it is checked.

optimize.steps=500              a stage by its name, also inside `during` if the name is unique
optimize.losses.0.weight=0.5    an item of a list by its index, from 0; losses[0] is the same
optimize.modules.exposure={}    an item of `modules` by its type: add or change it; null removes it
stages.1.steps=500              a stage by its index, if several have the same name
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
from clsplat.pipeline.explanation import annotations, bases, find_model, item_annotation, with_tags
from clsplat.pipeline.yaml_file import KeyPath, parse_value

MAX_SUGGESTIONS = 3
MAX_PARTS = 32  # in a key path; the longest in the settings has ten
NOT_SETTABLE = {"plugins": "runs write it; load a plug-in with --plugin FILE"}


class NoSuchKey(OverrideError):
    """The pipeline does not have a key."""


def split(text: str) -> tuple[list[str], str]:
    """Split KEY=VALUE into the parts of the key path and the value.  Raises OverrideError."""
    key_path, equals, value = text.partition("=")
    names = re.findall(r"[^.\[\]]+", key_path)
    if not equals or not 0 < len(names) <= MAX_PARTS:
        raise OverrideError(text, "expected KEY=VALUE, such as optimize.steps=500")
    return names, value


def apply(data: dict[str, Any], text: str, root: type[BaseModel]) -> KeyPath:
    """Apply `KEY=VALUE` to a file's data in place, and return the key path in the file.

    The stages in the data have the form {stage: NAME, …}.  Raises OverrideError.
    """
    _, value = split(text)
    try:
        new_value = parse_value(value)
    except ConfigError as error:
        raise OverrideError(text, f"cannot read the value: {error}") from error
    node, last = _parent(data, text, root)
    if isinstance(node.data, list) and node.is_keyed(last):
        node.put(last, new_value, text)
        return (*node.key_path, last)
    if isinstance(node.data, list):
        i = node.index(last, text)
        node.data[i] = with_tags(new_value, node.items)
        return (*node.key_path, i)
    if not isinstance(node.data, dict):
        raise NoSuchKey(text, f"{quote(node.key_path[-1])} has no keys")
    if not node.key_path and last not in root.model_fields:
        raise NoSuchKey(text, f"no key {quote(last)} at the top level of a pipeline")
    node.data[last] = with_tags(new_value, node.annotation(last))
    return (*node.key_path, last)


def _parent(data: dict[str, Any], text: str, root: type[BaseModel]) -> "tuple[_Node, str]":
    """Return the node that contains the key of KEY=VALUE, and the last part of the key.  Raises OverrideError."""
    names, _ = split(text)
    if names[0] in NOT_SETTABLE:
        raise OverrideError(text, f"'{names[0]}' cannot be set; {NOT_SETTABLE[names[0]]}")
    node = _Node(data, root, ())
    for name in names[:-1]:
        node = node.child(name, text)
    return node, names[-1]


class _Node:
    """A dict or list in a file's data, with its annotation and its key path in the file."""

    def __init__(self, data: Any, annotation: Any, key_path: KeyPath) -> None:
        self.data = data
        self.key_path = key_path
        self.model = find_model(data, annotation)
        self.items = item_annotation(annotation) if isinstance(data, list) else None

    def child(self, name: str, text: str) -> "_Node":
        """Return the node of a key.  A missing node is created from its default.  Raises OverrideError."""
        if isinstance(self.data, list) and self.is_keyed(name):
            if all(item["type"] != name for item in self.data):
                self.put(name, {}, text)
            item = next(item for item in self.data if item["type"] == name)
            return _Node(item, self.items, (*self.key_path, name))
        if isinstance(self.data, list):
            return self._item(self.index(name, text))
        if not isinstance(self.data, dict):
            raise NoSuchKey(text, f"{quote(self.key_path[-1])} has no keys")
        if stage := self._stage(name, text):
            return stage
        if self.data.get(name) is None:
            if not self.key_path and name not in self._fields:
                raise NoSuchKey(text, f"no {quote(name)} in this pipeline")
            default = self._fields[name].get_default(call_default_factory=True) if name in self._fields else None
            is_list = isinstance(default, list)
            self.data[name] = _to_plain(default) if isinstance(default, BaseModel) else [] if is_list else {}
        return self._key(name)

    def is_keyed(self, name: str) -> bool:
        """Return whether a name is the type of a list item, rather than an index."""
        keyed_by_type = any(base.keyed_by_type for base in bases(self.items))
        return (
            keyed_by_type
            and not name.isdigit()
            and all(isinstance(item, dict) and "type" in item for item in self.data)
        )

    def put(self, name: str, value: Any, text: str) -> None:
        """Replace the list item of a type, or insert a new item in order.  The value None removes the item.

        Raises OverrideError.
        """
        classes: dict[str, Any] = {key: class_ for base in bases(self.items) for key, class_ in variants(base).items()}
        if name not in classes:
            matches = difflib.get_close_matches(name, classes, n=1)
            hint = f"; did you mean {matches[0]}?" if matches else ""
            raise OverrideError(text, f"unknown type {quote(name)}; expected one of {', '.join(classes)}{hint}")
        if value is not None and not isinstance(value, dict):
            raise OverrideError(text, "expected a mapping of keys to values, such as {}, or null")
        types = [item["type"] for item in self.data]
        index = types.index(name) if name in types else None
        if index is not None:
            del self.data[index]
        if value is None:
            return
        if index is None:
            index = sum(getattr(classes.get(type_), "order", 0) <= classes[name].order for type_ in types)
        item = {"type": name, **{key: setting for key, setting in value.items() if key != "type"}}
        self.data.insert(index, with_tags(item, self.items))

    def index(self, name: str, text: str) -> int:
        """Parse a name as an index of the list.  Raises OverrideError."""
        if re.fullmatch(r"[0-9]{1,9}", name) and int(name) < len(self.data):
            return int(name)
        count = len(self.data)
        raise NoSuchKey(text, f"expected an index below {count} in a list of {count}, got {quote(name)}")

    @property
    def _fields(self) -> dict[str, Any]:
        return dict(self.model.model_fields) if self.model else {}

    def annotation(self, name: str) -> Any:
        """Return the annotation of a key, or None if the key is unknown."""
        return annotations(self.model).get(name) if self.model else None

    def _key(self, name: str) -> "_Node":
        annotation = self.annotation(name)
        self.data[name] = with_tags(self.data[name], annotation)  # a name alone has no keys
        return _Node(self.data[name], annotation, (*self.key_path, name))

    def _item(self, i: int) -> "_Node":
        item = self.data[i]
        name = [item["stage"]] if isinstance(item, dict) and "stage" in item else []
        return _Node(item, self.items, (*self.key_path, i, *name))

    def _stages(self) -> "list[_Node]":
        """Return the nodes of the stages in all lists of a map."""
        lists = [
            self._key(key)
            for key, value in self.data.items()
            if isinstance(value, list) and self._may_contain_stages(key)
        ]
        items = [node._item(i) for node in lists for i in range(len(node.data))]
        return [item for item in items if isinstance(item.data, dict) and "stage" in item.data]

    def _may_contain_stages(self, key: str) -> bool:
        """Return whether a list contains stages or has an unknown type."""
        item_bases = bases(item_annotation(self.annotation(key)))
        return self.annotation(key) is None or any(Variants(base).tag == "stage" for base in item_bases)

    def _stage(self, name: str, text: str) -> "_Node | None":
        """Return the node of the stage with a name, or None.  The root also searches the stages inside other stages.

        Raises OverrideError if several stages have the name.
        """
        stages = self._stages()
        matches = [node for node in stages if node.data["stage"] == name]
        if not matches and not self.key_path:
            matches = [inner for node in stages for inner in node._stages() if inner.data["stage"] == name]
        if len(matches) > 1:
            keys = shorten(" or ".join(_address(node.key_path) for node in matches), 200)
            raise OverrideError(text, f"{len(matches)} stages are named {quote(name)}; use {keys} instead")
        return matches[0] if matches else None


def _to_plain(default: BaseModel) -> dict[str, Any]:
    """Return a model as plain data for a pipeline file: its tag, and the keys whose values are not the defaults."""
    values = default.model_dump(mode="json", exclude_defaults=True)
    return {**{name: getattr(default, name) for name in TAGS if hasattr(default, name)}, **values}


def _address(key_path: KeyPath) -> str:
    """Return the address of a stage: its key path with indices, but without the names of stages."""
    return ".".join(str(part) for i, part in enumerate(key_path) if not (i and isinstance(key_path[i - 1], int)))


def suggestion(names: Sequence[str], key_paths: Sequence[str]) -> str:
    """Return '; did you mean …?' with the key paths that end with `names` or resemble them, or '' if none do."""
    key_path = ".".join(names)
    similar_paths = [path for path in key_paths if path.endswith(f".{key_path}")]
    similar_paths = similar_paths or difflib.get_close_matches(key_path, key_paths, n=1)
    similar_paths = similar_paths or [path for path in key_paths if path.rpartition(".")[2] == names[-1]]
    if not similar_paths:
        similar_names = difflib.get_close_matches(names[-1], [path.rpartition(".")[2] for path in key_paths], n=1)
        similar_paths = [path for path in key_paths if path.rpartition(".")[2] in similar_names]
    return f"; did you mean {' or '.join(similar_paths[:MAX_SUGGESTIONS])}?" if similar_paths else ""


# The keys of a pipeline that `--set` can change, in its syntax.

CADENCE = ("every", "start", "stop")  # keys of stages inside `during` only


@dataclass(frozen=True)
class Key:
    """A setting that `--set` can change."""

    key_path: str  # in the syntax of --set, such as optimize.losses.0.weight
    value: Any  # plain data
    description: str

    @property
    def text(self) -> str:
        """KEY=VALUE, in the syntax of --set."""
        return f"{self.key_path}={value_text(self.value)}"


def list_keys(settings: BaseModel) -> list[Key]:
    """Return all keys of checked settings, in order."""
    return list(_keys(settings, "", _addresses(settings)))


def _keys(model: BaseModel, prefix: str, addresses: dict[int, str]) -> Iterator[Key]:
    plain_values = model.model_dump(mode="json")
    has_no_cadence = hasattr(model, "every") and model.every is None
    fields, help_texts = type(model).model_fields, descriptions(type(model))
    for name in sorted(fields, key=lambda name: name != "type"):
        value = getattr(model, name)
        if name in ("stage", *NOT_SETTABLE) or (has_no_cadence and name in CADENCE):
            continue
        items = value if isinstance(value, list) and value and isinstance(value[0], BaseModel) else None
        if isinstance(value, BaseModel):
            yield from _keys(value, f"{prefix}{name}.", addresses)
        elif items is not None:
            for i, item in enumerate(items):
                key = item.type if getattr(item, "keyed_by_type", False) else i
                yield from _keys(item, addresses.get(id(item), f"{prefix}{name}.{key}") + ".", addresses)
        else:
            yield Key(prefix + name, plain_values.get(name), help_texts.get(name, ""))


def _addresses(settings: BaseModel) -> dict[int, str]:
    """Return the shortest key path of each stage, by id: its name, OUTER.NAME, or a path with an index."""
    outer_stages = list(_stages(settings))
    names = [stage.stage for _, stage in outer_stages]
    inner_stages = [(i, list(_stages(stage))) for i, (_, stage) in enumerate(outer_stages)]
    inner_names = [stage.stage for _, stages in inner_stages for _, stage in stages]
    addresses = {
        id(stage): stage.stage if names.count(stage.stage) == 1 else key_path for key_path, stage in outer_stages
    }  # fmt: skip
    for i, stages in inner_stages:
        sibling_names = [stage.stage for _, stage in stages]
        prefix = addresses[id(outer_stages[i][1])]
        for key_path, stage in stages:
            if stage.stage not in names and inner_names.count(stage.stage) == 1:
                addresses[id(stage)] = stage.stage
            elif sibling_names.count(stage.stage) == 1:
                addresses[id(stage)] = f"{prefix}.{stage.stage}"
            else:
                addresses[id(stage)] = f"{prefix}.{key_path}"
    return addresses


def _stages(model: BaseModel) -> Iterator[tuple[str, Any]]:
    """Yield the stages in the lists of a model, each with its key path in the model."""
    for name in type(model).model_fields:
        value = getattr(model, name)
        for i, item in enumerate(value if isinstance(value, list) else []):
            if hasattr(item, "stage"):
                yield f"{name}.{i}", item


def value_text(value: Any) -> str:
    """Format a value in the syntax of --set, with as few quotes as possible."""
    text = f"[{','.join(map(value_text, value))}]" if isinstance(value, list) else str(value)
    try:
        return text if parse_value(text) == value and not isinstance(value, bool) else json.dumps(value)
    except ConfigError:
        return json.dumps(value, ensure_ascii=False)
