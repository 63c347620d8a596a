"""Read a pipeline file with `matrix:`: one run for each combination of pipelines, scenes, settings, and seeds.

    name: ablation
    matrix:
      pipelines: [splat_7k, my_variant.yaml]   # default: the stages of this file
      scenes: [data/lego, data/garden]
      seeds: [0, 1, 2]
      set:                                     # each key takes each value of its list
        densify.every: [100, 200]
      steps: 2000                              # per cell; schedules are stretched to fit

Each run is a cell of the matrix, in a subfolder of the run folder.  The name of a cell contains its value on each axis.
"""

import itertools
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, JsonValue, ValidationError, model_validator

from clsplat.core.errors import ConfigError, OverrideError, quote, shorten
from clsplat.core.files import invalid_output_reason
from clsplat.core.settings import InputPath, Settings
from clsplat.pipeline.execution import Execution, LocalExecution
from clsplat.pipeline.explanation import explain, key_path_text
from clsplat.pipeline.file import Name
from clsplat.pipeline.files import find
from clsplat.pipeline.loading import Pipeline, check_document
from clsplat.pipeline.stretching import stretch_to_steps
from clsplat.pipeline.yaml_file import Document, KeyPath, read_pipeline, read_yaml, yaml_text

# Short labels for the values of a matrix, from which the names of its cells are built.


def shortest_labels(paths: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the shortest ending of each path that is unique among the paths, with its parts joined by hyphens."""
    for length in range(1, max((len(parts) for parts in paths), default=0) + 1):
        names = ["-".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return ["-".join(parts) for parts in paths]


def value_text(value: Any) -> str:
    """Format a value for the name of a cell."""
    if isinstance(value, list):
        return "+".join(value_text(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value)


MAX_CELLS = 1000


class Matrix(Settings):
    """The axes of a matrix."""

    pipelines: list[InputPath] = Field([])
    """Pipeline files, or names of shipped pipelines; default: the stages of this file."""
    scenes: list[InputPath] = Field([])
    """Folders of datasets; default: the scene of the pipeline or of --scene."""
    seeds: list[Annotated[int, Field(ge=0, lt=2**32)]] = Field([])
    """Seeds; default: the seed of the pipeline."""
    set: dict[str, Annotated[list[JsonValue], Field(min_length=1)]] = Field({})
    """Settings by key, as for --set, each with a list of values."""
    steps: Annotated[int, Field(ge=1)] | None = None
    """Steps of each cell's training; schedules are stretched to fit; default: as in the pipelines."""
    options: list[str] = Field([])
    """Settings of all cells, as key=value.  A run adds the values of --set and --scene in its copy of the file."""

    @model_validator(mode="after")
    def _check_axes(self) -> "Matrix":
        axes: dict[str, list[Any]] = {
            "pipelines": self.pipelines,
            "scenes": self.scenes,
            "seeds": self.seeds,
            **self.set,
        }
        if not any(axes.values()):
            raise ValueError("expected at least one of pipelines, scenes, seeds, and set")
        for key, axis in axes.items():
            if len({json.dumps(value) for value in axis}) < len(axis):
                raise ValueError(f"duplicate value in {quote(axis)} of '{key}'; list each value once")
        return self


class MatrixFile(Settings):
    """The keys of a file with `matrix:`.  Without `matrix.pipelines`, it also has the keys of a pipeline."""

    name: Name
    """Name of the matrix, and of its run folder."""
    matrix: Matrix
    """The axes."""
    execution: LocalExecution = LocalExecution()
    """How the cells run on this machine; `--on FILE` replaces it; default: one after another in the run folder."""


@dataclass(frozen=True)
class Cell:
    """A run of a matrix."""

    name: str  # name of the cell and of its folder
    pipeline: Pipeline


@dataclass(frozen=True)
class Experiment:
    """All runs of a file with `matrix:`."""

    path: Path
    name: str
    text: str  # content of the file, with the options of the command
    cells: list[Cell]
    execution: Execution = field(default_factory=Execution)


@dataclass(frozen=True)
class _Choice:
    """A value on an axis."""

    label: str
    override: str  # key=value
    key_path: KeyPath  # in the file


def load_experiment(
    name: str, overrides: Sequence[str] = (), execution: dict[str, Any] | None = None
) -> Experiment | None:
    """Read and check a pipeline file with `matrix:` and all its cells; return None for a file without `matrix:`.

    execution: keys that replace the file's `execution:`.  They are omitted from the experiment's text, which may be
    shared.
    Raises ConfigError with the file and line.
    """
    path = find(name)
    document = read_yaml(path)
    if not isinstance(document.data, dict) or "matrix" not in document.data:
        return None
    has_pipelines = isinstance(document.data["matrix"], dict) and document.data["matrix"].get("pipelines")
    try:
        keys = document.data if has_pipelines else document.data.keys() & MatrixFile.model_fields.keys()
        file = MatrixFile.model_validate({key: document.data[key] for key in document.data if key in keys})
    except ValidationError as error:
        raise ConfigError(explain(error, MatrixFile, path, document)) from error
    has_options = bool(overrides) or execution is not None
    overrides = _last_overrides([*file.matrix.options, *overrides])
    axes = _axes(file.matrix)
    _check_overrides(path, axes, overrides)
    bases = _bases(path, document, file.matrix)
    if (count := len(bases) * math.prod(len(axis) for axis in axes)) > MAX_CELLS:
        raise ConfigError(f"{path}: the matrix has {count} cells; the limit is {MAX_CELLS}: list fewer values")
    for base in bases:
        _check_choices(path, document, base, axes, overrides)
    cells = [_cell(base, choices, overrides) for base in bases for choices in itertools.product(*axes)]
    if file.matrix.steps is not None:
        cells = [_with_steps(cell, file.matrix.steps) for cell in cells]
    _check_names(path, cells)
    data = {**document.data, "matrix": {**document.data["matrix"], "options": overrides}}
    if execution is None:
        execution = document.data.get("execution", {})
    else:
        data.pop("execution", None)
    text = yaml_text(data) if has_options else read_pipeline(path)
    return Experiment(path, file.name, text, cells, Execution.model_validate(execution))


@dataclass(frozen=True)
class _Base:
    """A pipeline of the matrix, before the settings of its cells are applied."""

    label: str  # "" for the file with the matrix
    path: Path
    document: Document


def _bases(path: Path, document: Document, matrix: Matrix) -> list[_Base]:
    if not matrix.pipelines:
        data = {key: value for key, value in document.data.items() if key not in ("matrix", "execution")}
        return [_Base("", path, Document(data, document.lines))]
    bases = []
    for i, name in enumerate(matrix.pipelines):
        try:
            file = find(name)
            base = _Base(file.stem, file, read_yaml(file))
            check_document(base.path, base.document)
        except ConfigError as error:
            line = document.line(("matrix", "pipelines", i))
            raise ConfigError(f"{path}:{line}: matrix.pipelines[{i}]: {error}") from error
        bases.append(base)
    return bases


def _axes(matrix: Matrix) -> list[list[_Choice]]:
    """Return all axes except the pipelines, in the order in which they appear in the names of cells."""
    axes = []
    if matrix.scenes:
        labels = shortest_labels([Path(scene).parts for scene in matrix.scenes])
        axes.append([
            _Choice(label, _override("scene.path", str(Path(scene).resolve())), ("matrix", "scenes", i))
            for i, (label, scene) in enumerate(zip(labels, matrix.scenes, strict=True))
        ])  # fmt: skip
    keys = shortest_labels([tuple(key.split(".")) for key in matrix.set])
    for short_key, (key, values) in zip(keys, matrix.set.items(), strict=True):
        axes.append([
            _Choice(f"{short_key}={value_text(value)}", _override(key, value), ("matrix", "set", key, i))
            for i, value in enumerate(values)
        ])  # fmt: skip
    if matrix.seeds:
        axes.append([
            _Choice(f"seed={seed}", _override("seed", seed), ("matrix", "seeds", i))
            for i, seed in enumerate(matrix.seeds)
        ])  # fmt: skip
    return axes


def _cell(base: _Base, choices: Sequence[_Choice], overrides: Sequence[str]) -> Cell:
    labels = [base.label, *(choice.label for choice in choices)]
    name = re.sub(r"[^\w.=+-]+", "_", "-".join(label for label in labels if label))
    try:
        pipeline = check_document(base.path, base.document, [*overrides, *(choice.override for choice in choices)])
    except OverrideError as error:
        raise ConfigError(f"{base.path}: cell '{shorten(name)}' of the matrix: {error.reason}") from error
    return Cell(name, pipeline)


def _with_steps(cell: Cell, steps: int) -> Cell:
    return replace(cell, pipeline=replace(cell.pipeline, settings=stretch_to_steps(cell.pipeline.settings, steps)))


def _check_choices(
    path: Path, document: Document, base: _Base, axes: Sequence[Sequence[_Choice]], overrides: Sequence[str]
) -> None:
    """Check each value of the matrix separately.  Raises ConfigError with the key of the first invalid value."""
    check_document(base.path, base.document, list(overrides))
    for choice in itertools.chain(*axes):
        try:
            check_document(base.path, base.document, [*overrides, choice.override])
        except OverrideError as error:
            key_path, line = key_path_text(choice.key_path), document.line(choice.key_path)
            raise ConfigError(f"{path}:{line}: {key_path}: {error.reason}") from error


def _check_overrides(path: Path, axes: Sequence[Sequence[_Choice]], overrides: Sequence[str]) -> None:
    swept_keys = {choice.override.partition("=")[0] for axis in axes for choice in axis}
    for override in overrides:
        if (key_path := override.partition("=")[0]) in swept_keys:
            raise ConfigError(f"{path}: the matrix already lists values of {key_path}; change that list instead")


def _check_names(path: Path, cells: Sequence[Cell]) -> None:
    for cell in cells:
        if fault := invalid_output_reason(cell.name):
            raise ConfigError(f"{path}: a cell of the matrix would be named '{shorten(cell.name)}': {fault}")
    names = [cell.name.casefold() for cell in cells]  # some file systems ignore case
    if duplicate := next((cell.name for cell in cells if names.count(cell.name.casefold()) > 1), None):
        raise ConfigError(
            f"{path}: two cells of the matrix would be named '{duplicate}'; rename a pipeline or a folder"
        )


def _last_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the last override of each key."""
    keys = [override.partition("=")[0] for override in overrides]
    return [override for i, override in enumerate(overrides) if keys[i] not in keys[i + 1 :]]


def _override(key_path: str, value: Any) -> str:
    return f"{key_path}={json.dumps(value)}"
