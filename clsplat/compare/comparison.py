"""Runs, sorted into variants and rows.

Runs with the same settings are one variant, whatever their scene and seed.  Runs of a variant on one scene are one row:
their mean, and the deviation between seeds.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from clsplat.compare.differences import differing, flat
from clsplat.compare.run_folder import RunFolder, read_settings
from clsplat.errors import ConfigError, DataError
from clsplat.names import PIPELINE
from clsplat.pages.svg import COLOURS
from clsplat.scene.scene import scene_name

MAX_SETTINGS = 3  # differing ones in a variant's name


@dataclass(frozen=True)
class Variant:
    """Settings with a letter and a colour, which are the same on the whole page."""

    letter: str
    name: str
    colour: str
    settings: dict[str, str]  # place -> value, without scene and seed; with the device


@dataclass(frozen=True)
class Row:
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
class Comparison:
    """All runs, sorted into variants and rows."""

    runs: list[RunFolder]

    @classmethod
    def read(cls, paths: Sequence[Path]) -> "Comparison":
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
            Variant(_letter(i), _name(settings, distinct), COLOURS[i % len(COLOURS)], settings)
            for i, settings in enumerate(distinct)
        ]

    @cached_property
    def scenes(self) -> dict[str, list[Row]]:
        """Rows by the scene's name, in the order of the runs."""
        grouped: dict[str, list[RunFolder]] = {}
        for run in self.runs:
            grouped.setdefault(run.scene.model_dump_json(), []).append(run)
        names = _scene_names([runs[0] for runs in grouped.values()])
        return {name: list(self._rows(runs)) for name, runs in zip(names, grouped.values(), strict=True)}

    def variant(self, run: RunFolder) -> Variant:
        """Return the variant of a run."""
        return next(variant for variant in self.variants if variant.settings == _settings(run))

    def _rows(self, runs: Sequence[RunFolder]) -> Iterator[Row]:
        for variant in self.variants:
            if own := [run for run in runs if self.variant(run) is variant]:
                yield Row(variant, sorted(own, key=lambda run: run.metrics.seed))


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
