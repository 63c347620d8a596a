"""From a pipeline file to checked stages, and through them.

    name, seed, scene: {path, downscale, background, …}, model: {…}, rasterizer: {schedule, sort, …}
    stages: a list of   - <stage>   or   - <stage>: {field: value, …}

A file is complete and strict: unknown keys are errors, every value has its default in its model, and the fully resolved
file is written to the run folder.
"""

import copy
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from ruamel.yaml import YAML

from clsplat.errors import ConfigError, OverrideError, one_line
from clsplat.filters import ModelSettings
from clsplat.opencl.device import Schedule
from clsplat.overrides import NoSuchKey, apply, split, suggestion
from clsplat.pipeline_files import find
from clsplat.prepare.cache import Planned, plan
from clsplat.prepare.steps import AnyStep
from clsplat.render.rasterizer import RECORD, UNLIMITED, Budget
from clsplat.render.tiles import Sort
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Alpha, Background, Scene
from clsplat.settable import settable
from clsplat.settings import Settings
from clsplat.settings_errors import explain, first_fault, place_text
from clsplat.stages import STAGES, AnyStage
from clsplat.stages.base import Stage
from clsplat.stages.optimize import Optimize
from clsplat.views.order import Sampling
from clsplat.yaml_file import Document, read_yaml

LOG = logging.getLogger("clsplat")


class SceneSettings(Settings):
    """Which photographs, and how they are read."""

    path: str | None = None  # usually given by --scene
    downscale: Annotated[float, Field(ge=1)] = 1  # image sizes are divided by this
    levels: Annotated[int, Field(ge=1, le=8)] = 1  # scales to train on: downscale, and twice, four times, … that
    sampling: Sampling = "uniform"  # of views among several levels
    alpha: Alpha = "transparency"  # of photographs: blended with the background, or a mask of what counts
    background: Literal["auto", "black", "white"] = "auto"  # auto: white for Blender scenes, else black
    image_budget: Annotated[int, Field(gt=0)] | None = (
        None  # MiB of photographs on the device; default: a quarter of it
    )
    holdout: Annotated[int, Field(ge=0)] = 8  # every n-th image, by name, is a test view; 0: none

    @property
    def scales(self) -> tuple[float, ...]:
        """What the original photographs' sizes are divided by for training, from the finest."""
        return tuple(self.downscale * 2**level for level in range(self.levels))

    @property
    def folder(self) -> Path:
        """Where the photographs lie.  Raises ConfigError when nobody said so."""
        if self.path is None:
            raise ConfigError("no scene given; use --scene DIR, or scene: {path: DIR} in the pipeline file")
        return Path(self.path)

    def read(self, folder: Path) -> tuple[Scene, Background]:
        """Return the photographs of a folder, and what they are shown on.  Raises DataError."""
        scene = read_scene(folder, self.holdout).with_alpha(self.alpha)
        return scene, scene.background if self.background == "auto" else self.background


class RasterizerSettings(Settings):
    """How the device works; results do not depend on it."""

    schedule: Schedule = "auto"
    sort: Sort = "auto"
    pair_budget: Annotated[int, Field(gt=0)] | None = None  # MiB of gradient records; default: the largest buffer
    launch_tiles: Annotated[int, Field(ge=0)] = 0  # tiles blended by one launch, for watchdogs of displays; 0: all

    def budget(self) -> Budget | None:
        """How much the rasterizer does at a time."""
        if self.pair_budget is None and self.launch_tiles == 0:
            return None
        records = UNLIMITED if self.pair_budget is None else (self.pair_budget << 20) // (4 * RECORD)
        return Budget(records, self.launch_tiles)


LISTS = ("prepare", "stages")
Name = Annotated[str, Field(pattern=r"^[\w.-]+$")]


class PipelineFile(Settings):
    """All that a pipeline file can say."""

    name: Name
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    scene: SceneSettings = SceneSettings()
    model: ModelSettings = ModelSettings()
    rasterizer: RasterizerSettings = RasterizerSettings()
    prepare: list[Annotated[AnyStep, Field(discriminator="stage")]] = Field([])  # photographs -> scene, done once
    stages: Annotated[list[Annotated[AnyStage, Field(discriminator="stage")]], Field(min_length=1)]

    @property
    def training(self) -> Optimize:
        """The first stage that trains.  Raises ConfigError when none does."""
        for stage in self.stages:
            if isinstance(stage, Optimize):
                return stage
        raise ConfigError(f"{self.name}: expected a stage 'optimize', whose steps can be timed")


@dataclass(frozen=True)
class Pipeline:
    """A checked pipeline."""

    path: Path
    settings: PipelineFile

    @property
    def stages(self) -> list[Stage]:
        return list(self.settings.stages)

    def preparation(self, out: Path) -> list[Planned]:
        """What must be done to the photographs before a run in `out`, and why.  Raises DataError."""
        settings = self.settings
        return plan(settings.prepare, settings.scene.folder, prepared_folder(out)) if settings.prepare else []

    def resolved(self) -> dict[str, Any]:
        """Every setting with its value, as plain data in the shape of a file."""
        data = self.settings.model_dump(mode="json")
        data |= {key: [_untagged(stage) for stage in data[key]] for key in LISTS}
        return data

    def text(self) -> str:
        """The resolved file."""
        stream = io.StringIO()
        yaml = YAML(typ="safe")
        yaml.default_flow_style = None
        yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
        yaml.width = 120
        yaml.dump(self.resolved(), stream)
        return stream.getvalue()


def prepared_folder(out: Path) -> Path:
    """Where results of `prepare:` lie: beside the run folder, for all runs there."""
    return out.absolute().parent / "prepared"


def load(name: str, overrides: list[str] | None = None) -> Pipeline:
    """Read and check a pipeline: a path, or the name of a shipped one; `overrides` are 'stage.key=value'.

    Raises ConfigError naming file, line, place and the nearest match.
    """
    path = find(name)
    return checked(path, read_yaml(path), overrides or [])


def checked(path: Path, document: Document, overrides: Sequence[str] = ()) -> Pipeline:
    """Check what was read from a pipeline file; the document stays as it is.  Raises ConfigError as `load` does."""
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected keys such as name and stages")
    tagged = _tagged_file(document, path)
    data = copy.deepcopy(tagged)
    try:
        for override in overrides:
            apply(data, override, PipelineFile)
        return Pipeline(path, _validated(data, path, document))
    except ConfigError:
        _blame(tagged, overrides, path, document)
        raise


def _validated(data: dict[str, Any], path: Path, document: Document) -> PipelineFile:
    try:
        settings = PipelineFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, PipelineFile, path, document)) from error
    _check_order(path, settings)
    return settings


def _blame(data: dict[str, Any], overrides: Sequence[str], path: Path, document: Document) -> None:
    """Raise the error of the file alone, else that of the first override which does not fit."""
    known = [key.place for key in settable(_validated(data, path, document))]
    for override in overrides:
        names, _ = split(override)
        try:
            place = apply(data, override, PipelineFile)
        except NoSuchKey as error:
            raise OverrideError(override, error.reason + suggestion(names, known)) from error
        try:
            _check_order(path, PipelineFile.model_validate(data))
        except ValidationError as error:
            where, complaint = first_fault(error, PipelineFile)
            around = where == place[: len(where)]
            raise OverrideError(override, complaint if around else f"{place_text(where)}: {complaint}") from error
        except ConfigError as error:
            raise OverrideError(override, one_line(error).removeprefix(f"{path}: ")) from error


def _tagged_file(document: Document, path: Path) -> dict[str, Any]:
    """The file's data with each stage as {stage: name, …}, which is how the models tell them apart."""
    data = dict(document.data)
    for key in LISTS:
        if isinstance(data.get(key), list):
            data[key] = [_tagged(item, (key, i), document, path) for i, item in enumerate(data[key])]
    return data


def _tagged(item: Any, place: tuple[str | int, ...], document: Document, path: Path) -> Any:
    if isinstance(item, str):
        return {"stage": item}
    if not (isinstance(item, dict) and len(item) == 1 and isinstance(next(iter(item.values())), dict | None)):
        where = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in place[:2])
        raise ConfigError(f"{path}:{document.line(place)}: {where}: expected '- stage' or '- stage: {{key: value}}'")
    name, fields = next(iter(item.items()))
    fields = dict(fields or {})
    if isinstance(fields.get("during"), list):
        fields["during"] = [
            _tagged(inner, (*place, name, "during", i), document, path) for i, inner in enumerate(fields["during"])
        ]
    return {"stage": name, **fields}


def _untagged(stage: dict[str, Any]) -> dict[str, Any]:
    fields = {key: value for key, value in stage.items() if key != "stage"}
    if fields.get("every") is None:  # a cadence belongs inside `during` only
        fields = {key: value for key, value in fields.items() if key not in ("every", "start", "stop")}
    if "during" in fields:
        fields["during"] = [_untagged(inner) for inner in fields["during"]]
    return {stage["stage"]: fields}


def _check_order(path: Path, settings: PipelineFile) -> None:
    """Every stage finds what it needs made before it."""
    made = {"scene"}
    for i, stage in enumerate(settings.stages):
        if stage.every is not None:
            raise ConfigError(f"{path}: stages[{i}] {stage.stage}: 'every' belongs inside optimize.during")
        for need in sorted(stage.needs - made):
            makers = ", ".join(name for name, kind in STAGES.items() if need in kind.makes)
            raise ConfigError(
                f"{path}: stages[{i}] {stage.stage} needs '{need}', which no earlier stage makes ({makers} makes it)"
            )
        made |= stage.makes
