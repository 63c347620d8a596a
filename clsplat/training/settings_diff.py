"""Compare two resolved pipelines, and tell which differences a resumed run allows."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

from clsplat.core.errors import shorten
from clsplat.core.settings import TAGS, Settings, resume_effect, tag_of

Kind = Literal["output", "training"] | None


class Difference(NamedTuple):
    """A setting that differs between two resolved pipelines."""

    place: str  # such as stages[1].optimize.rates.quats
    was: Any
    now: Any
    kind: Kind  # from its class; None: the setting cannot change on resume

    def __str__(self) -> str:
        return f"{self.place} was {shorten(repr(self.was), 80)}, is {shorten(repr(self.now), 80)}"

    def is_of_place(self, were: Mapping[str, str], are: Mapping[str, str]) -> bool:
        """Return whether a file was only moved.  were, are: hashes of the files that settings name, by path."""
        is_text = isinstance(self.was, str) and isinstance(self.now, str)
        return is_text and self.was in were and were[self.was] == are.get(self.now)

    @property
    def stage(self) -> int | None:
        """The index of its stage in the pipeline; None outside of stages."""
        found = re.match(r"stages\[(\d+)\]", self.place)
        return int(found[1]) if found else None


def differences(old: Any, new: Any, settings: Any = None, place: str = "", kind: Kind = None) -> Iterator[Difference]:
    """Yield the differences of two resolved pipelines, in order.

    settings: the settings that `new` was resolved from; their classes define the kinds.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            inner, of = _inside(settings, key)
            where = f"{place}.{key}" if place else str(key)
            yield from differences(old.get(key), new.get(key), inner, where, kind or of)
    elif isinstance(old, list) and isinstance(new, list) and (kinds := _kinds([*old, *new])):
        before, after = ({one["type"]: one for one in items} for items in (old, new))
        now = {one.type: one for one in settings or ()}
        for name in dict.fromkeys([*before, *after]):
            own = kind or (
                "training" if kinds[name].optional_on_resume and not {name} <= before.keys() & after.keys() else None
            )
            yield from differences(before.get(name), after.get(name), now.get(name), f"{place}.{name}", own)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (before, after) in enumerate(zip(old, new, strict=True)):
            inner = settings[i] if isinstance(settings, list) else None
            yield from differences(before, after, inner, f"{place}[{i}]", kind)
    elif old != new:
        yield Difference(place, old, new, kind)


def _kinds(items: list[Any]) -> dict[str, Any]:
    """Return the classes of a list's items by type, if the items are addressed by type."""
    known = {tag[1]: kind for kind in Settings.defined if kind.keyed_by_type and (tag := tag_of(kind))}
    named = [str(one.get("type")) if isinstance(one, dict) else "" for one in items]
    return {name: known[name] for name in named} if all(name in known for name in named) else {}


def first_difference(old: Any, new: Any) -> Difference | None:
    """Return the first difference of two resolved pipelines, or None."""
    return next(differences(old, new), None)


def _inside(settings: Any, key: str) -> tuple[Any, Kind]:
    """Return the settings below a key, and what a change of the key means on resume."""
    if not isinstance(settings, Settings):
        return None, None
    if key in type(settings).model_fields:
        return getattr(settings, key), resume_effect(type(settings), key)
    named = any(getattr(settings, tag, None) == key for tag in TAGS)  # a stage is written as {name: fields}
    return settings if named else None, None
