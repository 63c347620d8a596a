"""Compare two resolved pipelines, and classify the differences by whether a resumed run allows them."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

from clsplat.core.errors import shorten
from clsplat.core.settings import TAGS, Settings, resume_effect, variant_tag

Kind = Literal["output", "training"] | None


class Difference(NamedTuple):
    """A setting that differs between two resolved pipelines."""

    key_path: str  # path of the setting, such as stages[1].optimize.rates.quats
    old: Any
    new: Any
    kind: Kind  # kind that its class defines; None: the setting cannot change on resume

    def __str__(self) -> str:
        return f"{self.key_path} was {shorten(repr(self.old), 80)}, is {shorten(repr(self.new), 80)}"

    def is_moved_file(self, old_hashes: Mapping[str, str], new_hashes: Mapping[str, str]) -> bool:
        """Return whether only the path of a file changed.  old_hashes, new_hashes: hashes of input files by path."""
        is_text = isinstance(self.old, str) and isinstance(self.new, str)
        return is_text and self.old in old_hashes and old_hashes[self.old] == new_hashes.get(self.new)

    @property
    def stage(self) -> int | None:
        """The index of the setting's stage in the pipeline; None if the setting is not in a stage."""
        match = re.match(r"stages\[(\d+)\]", self.key_path)
        return int(match[1]) if match else None


def differences(
    old: Any, new: Any, settings: Any = None, key_path: str = "", kind: Kind = None
) -> Iterator[Difference]:
    """Yield the differences between two resolved pipelines, in order.

    settings: the settings that `new` was resolved from; their classes define the kinds.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            child, child_kind = _child(settings, key)
            path = f"{key_path}.{key}" if key_path else str(key)
            yield from differences(old.get(key), new.get(key), child, path, kind or child_kind)
    elif isinstance(old, list) and isinstance(new, list) and (classes := _item_classes([*old, *new])):
        before, after = ({item["type"]: item for item in entries} for entries in (old, new))
        items = {item.type: item for item in settings or ()}
        for name in dict.fromkeys([*before, *after]):
            item_kind = kind or (
                "training" if classes[name].optional_on_resume and not {name} <= before.keys() & after.keys() else None
            )
            yield from differences(before.get(name), after.get(name), items.get(name), f"{key_path}.{name}", item_kind)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (before, after) in enumerate(zip(old, new, strict=True)):
            child = settings[i] if isinstance(settings, list) else None
            yield from differences(before, after, child, f"{key_path}[{i}]", kind)
    elif old != new:
        yield Difference(key_path, old, new, kind)


def _item_classes(items: list[Any]) -> dict[str, Any]:
    """Return the settings classes of a list's items, keyed by type; empty unless all items are addressed by type."""
    classes = {tag[1]: cls for cls in Settings.subclasses if cls.keyed_by_type and (tag := variant_tag(cls))}
    types = [str(item.get("type")) if isinstance(item, dict) else "" for item in items]
    return {name: classes[name] for name in types} if all(name in classes for name in types) else {}


def first_difference(old: Any, new: Any) -> Difference | None:
    """Return the first difference between two resolved pipelines, or None."""
    return next(differences(old, new), None)


def _child(settings: Any, key: str) -> tuple[Any, Kind]:
    """Return the settings under a key, and the kind of a difference under that key."""
    if not isinstance(settings, Settings):
        return None, None
    if key in type(settings).model_fields:
        return getattr(settings, key), resume_effect(type(settings), key)
    is_tag = any(getattr(settings, tag, None) == key for tag in TAGS)  # a stage is written as {name: fields}
    return settings if is_tag else None, None
