"""Find in the code what a pipeline file can name.

Everything with a name is a subclass of `Settings` with a `type` or a `stage`; its fields are its keys.  All such
subclasses of one base are a family.
"""

import functools
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import AfterValidator
from pydantic.fields import FieldInfo

import clsplat.pipeline.recipes  # noqa: F401  (it imports all that a pipeline can name)
from clsplat.core.schedule import Curve, Decay, Every, Points
from clsplat.core.settings import Settings, descriptions
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.matrix import Matrix

ROOT = Path(__file__).resolve().parents[1]
Kind = type[Settings]
NOTATIONS = (Points, Decay, Every)  # of schedules, which have a separate page


class Family(NamedTuple):
    """The page that describes the subclasses of a base, and the key that holds them in a pipeline file."""

    page: str
    title: str
    key: str
    listed: bool = True


FAMILIES = {  # by the name of the base; any other family gets a separate page
    "Stage": Family("stages", "stage", "stages"),
    "Scheduled": Family("stages", "scheduled stage", "during"),
    "Training": Family("stages", "training stage", "stages"),
    "ValidatedTraining": Family("stages", "training stage with validation", "stages"),
    "Loss": Family("losses", "loss", "losses"),
    "ImageLoss": Family("losses", "loss on images", "losses"),
    "Penalty": Family("losses", "penalty", "losses"),
    "Rule": Family("rules", "density rule", "rules"),
    "Grow": Family("rules", "growing rule", "rules"),
    "Subdivide": Family("rules", "dividing rule", "rules"),
    "SampledPruning": Family("rules", "pruning rule with sampled views", "rules"),
    "WrongPixelsRule": Family("rules", "rule by wrong pixels", "rules"),
    "ScoredRule": Family("rules", "rule by score", "rules"),
    "Statistic": Family("statistics", "statistic", "statistic", listed=False),
    "Budget": Family("rules", "budget of Gaussians", "budget", listed=False),
    "Order": Family("views", "order", "order", listed=False),
    "PhotographTransform": Family("views", "transform", "transforms"),
    "TrainingModule": Family("modules", "training module", "modules"),
    "Appearance": Family("modules", "module for the colors of photographs", "modules"),
    "ColorModel": Family("modules", "model of colors", "model", listed=False),
    "WorldFilter": Family("filters", "world filter", "world_filter", listed=False),
    "ScreenFilter": Family("filters", "screen filter", "screen_filter", listed=False),
    "Backdrop": Family("filters", "background", "background", listed=False),
    "Step": Family("prepare", "prepare step", "prepare"),
    "Adaptation": Family("adaptations", "adaptation", "adapt", listed=False),
}


def subclasses(base: type) -> Iterator[type]:
    """Yield all subclasses of a base in the package."""
    for kind in base.__subclasses__():
        if kind.__module__.startswith("clsplat."):
            yield kind
            yield from subclasses(kind)


def tag(kind: Kind) -> str:
    """Return the name of a class in pipeline files, or "" if it has none."""
    defaults = [kind.model_fields[field].default for field in ("stage", "type") if field in kind.model_fields]
    return next((value for value in defaults if isinstance(value, str)), "")


@functools.cache
def families() -> dict[Kind, list[Kind]]:
    """Return every base with the subclasses that a pipeline file can name."""
    bases = [kind for kind in subclasses(Settings) if Settings in kind.__bases__]
    named = {base: sorted({kind for kind in subclasses(base) if tag(kind)}, key=tag) for base in bases}
    return {base: kinds for base, kinds in named.items() if kinds}


def family(base: Kind) -> Family:
    """Return the entry of a family."""
    name = base.__name__
    return FAMILIES.get(name, Family(name.lower(), name, name.lower()))


def groups(base: Kind) -> list[Kind]:
    """Return a base and its subclasses without a name that are bases of named ones."""
    named = families()[base]
    return [
        base,
        *(one for one in dict.fromkeys(subclasses(base)) if not tag(one) and any(issubclass(k, one) for k in named)),
    ]


@functools.cache
def unnamed_settings() -> dict[Kind, str]:
    """Return the settings without a name, each with the first key under which a pipeline file can hold it."""
    intermediate = {Curve, *(group for base in families() for group in groups(base))}
    found: dict[Kind, str] = {}
    waiting: list[tuple[Kind, str]] = [(PipelineFile, ""), (Matrix, "matrix")]
    met = {PipelineFile, Matrix}
    while waiting:
        kind, key = waiting.pop(0)
        if kind in families():  # a key takes one of the variants
            waiting += [(one, tag(one)) for one in families()[kind]]
            continue
        if kind not in intermediate and not tag(kind):
            found[kind] = key
        inner = [
            (one, f"{key}.{name}".strip("."))
            for name, field in kind.model_fields.items()
            for one in settings_classes(field)
        ]
        waiting += [(one, name) for one, name in inner if one not in met]
        met |= {one for one, _ in inner}
    return found


def settings_classes(field: FieldInfo) -> list[Kind]:
    """Return the settings classes in the annotation of a field."""
    return [part for part in annotation_parts(field) if isinstance(part, type) and issubclass(part, Settings)]


def annotation_parts(field: FieldInfo) -> list[Any]:
    """Return all parts of the annotation of a field, with its metadata."""

    def nested(annotation: Any) -> Iterator[Any]:
        yield annotation
        for argument in typing.get_args(annotation):
            yield from nested(argument)

    found = [*nested(field.annotation), *field.metadata]
    return [mark.func if isinstance(mark, AfterValidator) else mark for mark in found]


def undescribed_keys() -> list[str]:
    """Return the keys without a description, as Class.key."""
    kinds = [
        *unnamed_settings(),
        *NOTATIONS,
        *(kind for base, kinds in families().items() for kind in (*groups(base), *kinds)),
    ]
    return [
        f"{kind.__name__}.{name}"
        for kind in kinds
        for name in kind.model_fields
        if name not in ("type", "stage") and name not in descriptions(kind)
    ]
