"""What a pipeline file can name, found in the code: nothing is listed by hand.

Whatever has a name is a class below `Settings` with a `type` or a `stage`; its fields are its keys.  All such classes
below one base are a family.
"""

import functools
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import clsplat.schema  # noqa: F401  (it imports all that a pipeline can name)
from clsplat.matrix import Matrix
from clsplat.pipeline_settings import PipelineFile
from clsplat.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
Kind = type[Settings]


class Family(NamedTuple):
    """Where the classes below a base are described, and how a pipeline file holds them."""

    page: str
    title: str
    key: str
    listed: bool = True


FAMILIES = {  # by the name of the base; any other family gets a page of its own
    "Stage": Family("stages", "stage", "stages"),
    "Loss": Family("losses", "loss", "losses"),
    "Penalty": Family("losses", "penalty", "losses"),
    "Rule": Family("rules", "density rule", "rules"),
    "WorldFilter": Family("filters", "world filter", "world_filter", listed=False),
    "ScreenFilter": Family("filters", "screen filter", "screen_filter", listed=False),
    "Step": Family("prepare", "prepare step", "prepare"),
}


def below(base: type) -> Iterator[type]:
    """Yield all classes of the package below a base."""
    for kind in base.__subclasses__():
        if kind.__module__.startswith("clsplat."):
            yield kind
            yield from below(kind)


def tag(kind: Kind) -> str:
    """Return the name of a class in pipeline files; "" for those without."""
    defaults = [kind.model_fields[field].default for field in ("stage", "type") if field in kind.model_fields]
    return next((value for value in defaults if isinstance(value, str)), "")


@functools.cache
def families() -> dict[Kind, list[Kind]]:
    """Return every base, with all that a pipeline file can name of it."""
    bases = [kind for kind in below(Settings) if Settings in kind.__bases__]
    named = {base: sorted({kind for kind in below(base) if tag(kind)}, key=tag) for base in bases}
    return {base: kinds for base, kinds in named.items() if kinds}


def family(base: Kind) -> Family:
    """Return where a family is described."""
    name = base.__name__
    return FAMILIES.get(name, Family(name.lower(), name, name.lower()))


@functools.cache
def unnamed() -> dict[Kind, str]:
    """Return the settings without a name of their own, each with the key that a reader of a file meets first."""
    strategies = {kind for base, kinds in families().items() for kind in (base, *kinds)}
    found: dict[Kind, str] = {}
    waiting: list[tuple[Kind, str]] = [(PipelineFile, ""), (Matrix, "matrix")]
    met = {PipelineFile, Matrix}
    while waiting:
        kind, key = waiting.pop(0)
        if kind not in strategies:
            found[kind] = key
        inner = [(one, name) for name, field in kind.model_fields.items() for one in models(field.annotation)]
        waiting += [(one, name) for one, name in dict.fromkeys(inner) if one not in met]
        met |= {one for one, _ in inner}
    return found


def models(annotation: Any) -> Iterator[Kind]:
    """Yield the settings that an annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from models(argument)


def undescribed() -> list[str]:
    """Return the keys without a description, as Class.key."""
    kinds = [*unnamed(), *(kind for base, kinds in families().items() for kind in (base, *kinds))]
    return [
        f"{kind.__name__}.{name}"
        for kind in kinds
        for name, field in kind.model_fields.items()
        if name not in ("type", "stage") and not field.description
    ]
