"""Runs, sorted into variants and rows.

Runs with the same settings are one variant, whatever their scene and seed.  Runs of a variant on one scene are one row:
their mean, and the deviation between seeds.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import PIPELINE
from clsplat.pipeline.explanation import explain
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs.results import RunFolder, read_settings
from clsplat.scene.scene import scene_name
from clsplat.training.settings_diff import differences
from clsplat.viewer.charts import COLORS

# The settings in which resolved pipelines differ.


def flat(settings: dict[str, Any]) -> dict[str, str]:
    """Return place -> value as text, in the order of the file.

    A stage's place is its name and a strategy's its type, so that pipelines with different stages can be compared:
    `optimize.densify.clone.gradient_above`.  The second item of a name has `#2`.
    """
    found: dict[str, str] = {}
    for key, value in settings.items():
        _add(found, "" if key == "stages" else str(key), value)
    return found


def differing(settings: Sequence[dict[str, str]]) -> list[str]:
    """Return the places at which some of flat settings differ from the first."""
    first, *others = settings
    return list(dict.fromkeys(one.place for other in others for one in differences(first, other)))


def _add(found: dict[str, str], place: str, value: Any) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            _add(found, _joined(place, str(key)), inner)
        if not value:
            found[place] = "yes"
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        names: dict[str, int] = {}
        for item in value:
            name, inner = _named(item)
            names[name] = names.get(name, 0) + 1
            label = name if names[name] == 1 else f"{name}#{names[name]}"
            parent = place.removesuffix("during").removesuffix("rules").removesuffix("losses").rstrip(".")
            _add(found, _joined(parent, label), inner)
    else:
        found[place] = value if isinstance(value, str) else json.dumps(value)


def _named(item: Any) -> tuple[str, Any]:
    """The name of a list's item, and the item without it."""
    if isinstance(item, dict) and "type" in item:
        return str(item["type"]), {key: value for key, value in item.items() if key != "type"}
    if isinstance(item, dict) and {"key", "reason"} <= item.keys():  # a decision, whose value stands at its place
        return str(item["key"]), item["reason"]
    if isinstance(item, dict) and len(item) == 1:
        return next(iter(item.items()))
    return (str(item), {}) if not isinstance(item, dict) else ("item", item)


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


MAX_SETTINGS = 3  # differing ones in a variant's name


@dataclass(frozen=True)
class Variant:
    """Settings with a letter and a color, which are the same on the whole page."""

    letter: str
    name: str
    color: str
    settings: dict[str, str]  # place -> value, without scene and seed; with the device


@dataclass(frozen=True)
class VariantRow:
    """The runs of one variant on one scene, by seed."""

    variant: Variant
    runs: list[RunFolder]

    @property
    def downscale(self) -> str:
        """The divisor of the size of the largest photographs in training."""
        return f"{self.runs[0].scene.downscale:g}"

    def downscales(self, split: str) -> set[str]:
        """Return the divisors of the image sizes at which every run was measured."""
        measured: list[set[str]] = [set(getattr(run.metrics, split)) for run in self.runs]
        return set.intersection(*measured)

    def figures(self, split: str, downscale: str, metric: str) -> list[float]:
        """Return a metric of the runs; an empty list when a run lacks it."""
        averages = [getattr(run.metrics, split).get(downscale) for run in self.runs]
        values = [found.figure(metric) if found else None for found in averages]
        present = [value for value in values if value is not None]
        return present if len(present) == len(values) else []


@dataclass(frozen=True)
class RunComparison:
    """All runs, sorted into variants and rows."""

    runs: list[RunFolder]

    @classmethod
    def read(cls, paths: Sequence[Path]) -> "RunComparison":
        """Read run folders; the folder of a matrix means its finished cells.

        Raises DataError for a folder that is missing, unfinished or damaged, ConfigError for none, for one given twice
        or a pipeline.yaml that cannot be read.
        """
        if not paths:
            raise ConfigError("no runs to compare; expected the folder of at least one")
        runs = [RunFolder.read(folder) for path in paths for folder in _cells(path)]
        seen: set[Path] = set()
        for run in runs:
            if run.path.resolve() in seen:
                raise ConfigError(f"{run.path}: given twice; name each run once")
            seen.add(run.path.resolve())
        return cls(runs)

    @cached_property
    def variants(self) -> list[Variant]:
        """Variants in the order of the runs."""
        distinct: list[dict[str, str]] = []
        for run in self.runs:
            if (settings := _settings(run)) not in distinct:
                distinct.append(settings)
        return [
            Variant(_letter(i), _name(settings, distinct), COLORS[i % len(COLORS)], settings)
            for i, settings in enumerate(distinct)
        ]

    @cached_property
    def scenes(self) -> dict[str, list[VariantRow]]:
        """Rows by the scene's name, in the order of the runs."""
        grouped: dict[str, list[RunFolder]] = {}
        for run in self.runs:
            grouped.setdefault(run.scene.model_dump_json(), []).append(run)
        names = _scene_names([runs[0] for runs in grouped.values()])
        return {name: list(self._rows(runs)) for name, runs in zip(names, grouped.values(), strict=True)}

    def variant(self, run: RunFolder) -> Variant:
        """Return the variant of a run."""
        return next(variant for variant in self.variants if variant.settings == _settings(run))

    def _rows(self, runs: Sequence[RunFolder]) -> Iterator[VariantRow]:
        for variant in self.variants:
            if own := [run for run in runs if self.variant(run) is variant]:
                yield VariantRow(variant, sorted(own, key=lambda run: run.metrics.seed))


def _cells(path: Path) -> list[Path]:
    """The finished runs below the folder of a matrix; another folder stays as it is."""
    if not (path / PIPELINE).is_file() or "matrix" not in read_settings(path):
        return [path]
    cells = sorted(file.parent for file in path.glob("*/metrics.json"))
    if not cells:
        raise DataError(f"{path}: no cell of this matrix has finished; continue with --resume")
    return cells


def _settings(run: RunFolder) -> dict[str, str]:
    settings = {key: value for key, value in run.settings.items() if key not in ("scene", "seed")}
    return {**flat(settings), "device": run.metrics.device}


def _name(settings: dict[str, str], distinct: Sequence[dict[str, str]]) -> str:
    """The pipeline's name, and the settings in which variants of the same name differ."""
    places = differing([other for other in distinct if other.get("name") == settings.get("name")])
    parts = [f"{place.rpartition('.')[2]} {settings.get(place, 'unset')}" for place in places[:MAX_SETTINGS]]
    return ", ".join([settings.get("name", "unnamed"), *parts, *(["…"] if len(places) > MAX_SETTINGS else [])])


def _scene_names(runs: Sequence[RunFolder]) -> list[str]:
    """The folder's name and the size of images; where several scenes share both, all their settings too."""
    names = []
    for run in runs:
        size = f" at 1/{run.scene.downscale:g}" if run.scene.downscale != 1 else ""
        names.append(f"{scene_name(run.scene.path or 'scene')}{size}")
    return [
        name if names.count(name) == 1 else f"{name} {json.dumps(run.scene.model_dump(exclude_defaults=True))}"
        for name, run in zip(names, runs, strict=True)
    ]


def _letter(index: int) -> str:
    return (_letter(index // 26 - 1) if index >= 26 else "") + chr(ord("A") + index % 26)


# Published figures beside measured ones: a file of tables, each with its source and its protocol.

Text = Annotated[str, Field(min_length=1, max_length=2000)]


class PublishedTable(BaseModel):
    """One table of a publication."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    title: Text
    source: Text  # the publication, and how the figures came from there
    protocol: Text  # data, sizes, steps
    columns: Annotated[list[Text], Field(min_length=1)]
    rows: Annotated[dict[Text, list[float | None]], Field(min_length=1)]  # method -> figure of each column; null: none

    @model_validator(mode="after")
    def _whole(self) -> "PublishedTable":
        for name, figures in self.rows.items():
            if len(figures) != len(self.columns):
                raise ValueError(f"expected {len(self.columns)} figures of '{name}', one a column; got {len(figures)}")
        if all(one is None for figures in self.rows.values() for one in figures):
            raise ValueError("expected a figure")
        return self

    @property
    def shown(self) -> dict[str, list[str]]:
        """The figures of each method as text, all with as many digits as the one that has most."""
        digits = max(
            len(f"{one:.10g}".partition(".")[2]) for row in self.rows.values() for one in row if one is not None
        )
        return {name: ["–" if one is None else f"{one:.{digits}f}" for one in row] for name, row in self.rows.items()}


class Published(BaseModel):
    """The contents of a file of published tables."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    tables: Annotated[list[PublishedTable], Field(min_length=1)]


def read_published(path: Path) -> list[PublishedTable]:
    """Read the tables of a YAML file.  Raises ConfigError with its line where it holds something else."""
    document = read_yaml(path)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected the key tables")
    try:
        return Published.model_validate(document.data).tables
    except ValidationError as error:
        raise ConfigError(explain(error, Published, path, document)) from error
