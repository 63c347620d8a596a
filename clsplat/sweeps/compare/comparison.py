"""Group runs into variants and rows.

Runs with the same settings, except for scene and seed, form a variant.  The runs of a variant on one scene form a table
row, which shows their mean, and the standard deviation over seeds.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clsplat.core.errors import ConfigError, DataError, shorten
from clsplat.core.files import PIPELINE
from clsplat.pipeline.explanation import explain
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs.results import RunFolder, read_settings
from clsplat.scene.scene import scene_name
from clsplat.training.settings_diff import differences
from clsplat.viewer.charts import COLORS

# The differences between the settings of resolved pipelines.


def flatten(settings: dict[str, Any]) -> dict[str, str]:
    """Flatten settings to a dictionary from key path to value as text, in the order of the file.

    Key paths contain the names of stages and the types of strategies, as in `optimize.densify.clone.gradient_above`, so
    that pipelines with different stages can be compared.  A second item with the same name gets the suffix `#2`.
    """
    flat_settings: dict[str, str] = {}
    for key, value in settings.items():
        _add(flat_settings, "" if key == "stages" else str(key), value)
    return flat_settings


def differing_keys(settings: Sequence[dict[str, str]]) -> list[str]:
    """Return the key paths whose values differ between flat settings."""
    reference, *others = settings
    return list(dict.fromkeys(difference.key_path for other in others for difference in differences(reference, other)))


def _add(flat_settings: dict[str, str], key_path: str, value: Any) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            _add(flat_settings, _join(key_path, str(key)), inner)
        if not value:
            flat_settings[key_path] = "yes"
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        names: dict[str, int] = {}
        for item in value:
            name, inner = _split_item(item)
            names[name] = names.get(name, 0) + 1
            label = name if names[name] == 1 else f"{name}#{names[name]}"
            parent = key_path.removesuffix("during").removesuffix("rules").removesuffix("losses").rstrip(".")
            _add(flat_settings, _join(parent, label), inner)
    else:
        flat_settings[key_path] = value if isinstance(value, str) else json.dumps(value)


def _split_item(item: Any) -> tuple[str, Any]:
    """Return the name of a list item, and the item's settings without the name."""
    if isinstance(item, dict) and "type" in item:
        return str(item["type"]), {key: value for key, value in item.items() if key != "type"}

    if isinstance(item, dict) and len(item) == 1:
        return next(iter(item.items()))
    return (str(item), {}) if not isinstance(item, dict) else ("item", item)


def _join(key_path: str, name: str) -> str:
    return f"{key_path}.{name}" if key_path else name


MAX_DIFFERENCES = 3  # number of settings in the name of a variant
MAX_FOLDERS = 3  # number of folders that a variant lists
MAX_VALUE = 40  # number of characters of a value in a name


@dataclass(frozen=True)
class Variant:
    """Settings that several runs share, with the letter and the color that identify them on the page."""

    letter: str
    name: str
    color: str
    settings: dict[str, str]  # flat settings, without scene and seed, but with the device
    folders: str  # names of the folders of its runs


@dataclass(frozen=True)
class VariantRow:
    """The runs of one variant on one scene, in the order of their seeds."""

    variant: Variant
    runs: list[RunFolder]

    @property
    def downscale(self) -> str:
        """The divisor of the image size in training, as text; for several training sizes, that of the largest."""
        return f"{self.runs[0].scene.downscale:g}"

    def downscales(self, split: str) -> set[str]:
        """Return the divisors of the image size at which all runs were evaluated."""
        downscale_sets: list[set[str]] = [set(getattr(run.metrics, split)) for run in self.runs]
        return set.intersection(*downscale_sets)

    def values(self, split: str, downscale: str, metric: str) -> list[float]:
        """Return the value of a metric for each run, or an empty list if any run lacks it."""
        averages = [getattr(run.metrics, split).get(downscale) for run in self.runs]
        values = [average.value(metric) if average else None for average in averages]
        available_values = [value for value in values if value is not None]
        return available_values if len(available_values) == len(values) else []


@dataclass(frozen=True)
class RunComparison:
    """Runs to compare, grouped into variants and table rows."""

    runs: list[RunFolder]

    @classmethod
    def read(cls, paths: Sequence[Path]) -> "RunComparison":
        """Read run folders.  A matrix folder is replaced with the folders of its finished cells.

        Raises DataError if a folder is missing, unfinished, or damaged, and ConfigError if there is no folder, a folder
        is given twice, or a pipeline.yaml cannot be read.
        """
        if not paths:
            raise ConfigError("no runs to compare; pass at least one run folder")
        runs = [RunFolder.read(folder) for path in paths for folder in _finished_cell_folders(path)]
        resolved_paths: set[Path] = set()
        for run in runs:
            if run.path.resolve() in resolved_paths:
                raise ConfigError(f"{run.path}: is listed twice; list each run once")
            resolved_paths.add(run.path.resolve())
        return cls(runs)

    @cached_property
    def variants(self) -> list[Variant]:
        """The variants, in the order of the runs."""
        settings_by_run = [_settings(run) for run in self.runs]
        distinct_settings: list[dict[str, str]] = []
        for settings in settings_by_run:
            if settings not in distinct_settings:
                distinct_settings.append(settings)
        variants = []
        for i, settings in enumerate(distinct_settings):
            runs = [run for run, values in zip(self.runs, settings_by_run, strict=True) if values == settings]
            color = COLORS[i % len(COLORS)]
            variants.append(Variant(_letter(i), _name(settings, distinct_settings), color, settings, _folders(runs)))
        return variants

    @cached_property
    def scenes(self) -> dict[str, list[VariantRow]]:
        """The rows of each scene, by scene name, in the order of the runs."""
        runs_by_scene: dict[str, list[RunFolder]] = {}
        for run in self.runs:
            runs_by_scene.setdefault(run.scene.model_dump_json(), []).append(run)
        names = _scene_names([runs[0] for runs in runs_by_scene.values()])
        return {name: list(self._rows(runs)) for name, runs in zip(names, runs_by_scene.values(), strict=True)}

    def variant(self, run: RunFolder) -> Variant:
        """Return the variant of a run."""
        return next(variant for variant in self.variants if variant.settings == _settings(run))

    def _rows(self, runs: Sequence[RunFolder]) -> Iterator[VariantRow]:
        for variant in self.variants:
            if variant_runs := [run for run in runs if self.variant(run) is variant]:
                yield VariantRow(variant, sorted(variant_runs, key=lambda run: run.metrics.seed))


def _finished_cell_folders(path: Path) -> list[Path]:
    """Return the folders of the finished cells of a matrix folder; for another folder, the folder itself."""
    if not (path / PIPELINE).is_file() or "matrix" not in read_settings(path):
        return [path]
    cells = sorted(file.parent for file in path.glob("*/metrics.json"))
    if not cells:
        raise DataError(f"{path}: no cell of this matrix has finished; continue it with --resume")
    return cells


def _settings(run: RunFolder) -> dict[str, str]:
    """Return the flat settings that identify the variant of a run.

    Settings that `adapt` derived from the photos are omitted, because they differ between scenes, not between variants.
    """
    settings = {key: value for key, value in run.settings.items() if key not in ("scene", "seed", "adapt")}
    adapt = run.settings.get("adapt") or {}
    adapted_keys = [decision["key"] for decision in adapt.get("decisions") or ()]
    variant_settings = {
        path: value
        for path, value in flatten(settings).items()
        if not any(_is_below(path, key) for key in adapted_keys)
    }
    return {**variant_settings, **({"adapt": adapt["type"]} if adapt else {}), "device": run.metrics.device}


def _is_below(key_path: str, key: str) -> bool:
    """Return whether a flat key path is equal to, or below, a key in the notation of `--set`.

    `--set` numbers the stages, and flat paths contain their names: `optimize.during.0.max_gaussians` is equal to
    `optimize.densify.max_gaussians`.
    """
    names = iter(key_path.split("."))
    return all(name in names for name in key.split(".") if name != "during" and not name.isdigit())


def _name(settings: dict[str, str], distinct_settings: Sequence[dict[str, str]]) -> str:
    """Return the name of a variant: the name of its pipeline, and the settings in which it differs from most others."""
    siblings = [other for other in distinct_settings if other.get("name") == settings.get("name")]
    descriptions: list[str] = []
    for key_path in differing_keys(siblings):
        description, *others = (_describe_setting(key_path, variant, siblings) for variant in (settings, *siblings))
        if 2 * others.count(description) <= len(siblings) and description not in descriptions:
            descriptions.append(description)
    more = [f"and {len(descriptions) - MAX_DIFFERENCES} more"] if len(descriptions) > MAX_DIFFERENCES else []
    return ", ".join([settings.get("name", "unnamed"), *descriptions[:MAX_DIFFERENCES], *more])


def _describe_setting(key_path: str, settings: dict[str, str], siblings: Sequence[dict[str, str]]) -> str:
    """Describe a setting as text, such as "init opacity 0.3", "with prune large", or "without prune large"."""
    parts = key_path.split(".")
    for depth in range(1, len(parts) + 1):
        prefix = ".".join(parts[:depth])
        trees = [{path: v for path, v in values.items() if f"{path}.".startswith(f"{prefix}.")} for values in siblings]
        if not all(trees):  # a stage, rule, or key that only some variants have
            label = " ".join(parts[:depth][-2:]).replace("_", " ")
            if not any(f"{path}.".startswith(f"{prefix}.") for path in settings):
                return f"without {label}"
            if all(values == next(filter(None, trees)) for values in trees if values):
                return f"with {label}"
            break
    return f"{' '.join(parts[-2:]).replace('_', ' ')} {shorten(settings.get(key_path, 'unset'), MAX_VALUE)}"


def _folders(runs: Sequence[RunFolder]) -> str:
    names = list(dict.fromkeys(run.path.resolve().name for run in runs))
    more = f" and {len(names) - MAX_FOLDERS} more" if len(names) > MAX_FOLDERS else ""
    return ", ".join(names[:MAX_FOLDERS]) + more


def _scene_names(runs: Sequence[RunFolder]) -> list[str]:
    """Return a name for the scene of each run, from its folder and image size.

    If names are not unique, all scene settings are appended.
    """
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


# Published results to show next to the metrics of runs: tables, each with its source and protocol.

Text = Annotated[str, Field(min_length=1, max_length=2000)]


class PublishedTable(BaseModel):
    """A table of results from a publication."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    title: Text
    source: Text  # the publication, and how the values were extracted from it
    protocol: Text  # dataset, image sizes, steps
    columns: Annotated[list[Text], Field(min_length=1)]
    rows: Annotated[dict[Text, list[float | None]], Field(min_length=1)]  # by method: one value or null per column

    @model_validator(mode="after")
    def _check_rows(self) -> "PublishedTable":
        for name, values in self.rows.items():
            if len(values) != len(self.columns):
                raise ValueError(f"expected {len(self.columns)} values of '{name}', one per column; got {len(values)}")
        if all(value is None for values in self.rows.values() for value in values):
            raise ValueError("expected at least one value that is not null")
        return self

    @property
    def formatted_rows(self) -> dict[str, list[str]]:
        """The values of each method as text, all with the same number of decimals."""
        values = [value for row in self.rows.values() for value in row if value is not None]
        digits = max(len(f"{value:.10g}".partition(".")[2]) for value in values)
        return {
            name: ["–" if value is None else f"{value:.{digits}f}" for value in row] for name, row in self.rows.items()
        }


class Published(BaseModel):
    """The content of a file with published tables."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    tables: Annotated[list[PublishedTable], Field(min_length=1)]


def read_published(path: Path) -> list[PublishedTable]:
    """Read published tables from a YAML file.  Raises ConfigError, which names the line, if the content is invalid."""
    document = read_yaml(path)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected the key 'tables'")
    try:
        return Published.model_validate(document.data).tables
    except ValidationError as error:
        raise ConfigError(explain(error, Published, path, document)) from error
