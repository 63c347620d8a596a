"""From a pipeline file to checked stages, and through them.

    name, seed, scene: {path, downscale, background, …}, model: {…}, rasterizer: {schedule, sort, …}
    stages: a list of   - <stage>   or   - <stage>: {field: value, …}

A file is complete and strict: unknown keys are errors, every value has its default in its model, and the fully resolved
file is written to the run folder.
"""

import copy
import difflib
import io
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from ruamel.yaml import YAML

from clsplat import plugins, resource_dir
from clsplat.errors import ConfigError
from clsplat.filters import ModelSettings
from clsplat.opencl.device import Schedule
from clsplat.prepare.cache import Planned, plan
from clsplat.prepare.steps import Step
from clsplat.renamed import with_new_names
from clsplat.render.rasterizer import RECORD, UNLIMITED, Budget
from clsplat.render.tiles import Sort
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Alpha, Background, Scene
from clsplat.settings import OneOf, Settings, variants
from clsplat.settings_errors import explain
from clsplat.stages.base import Scheduled, Stage
from clsplat.stages.optimize import Optimize
from clsplat.yaml_file import Document, parse_scalar, read_yaml

LOG = logging.getLogger("clsplat")


class SceneSettings(Settings):
    """Which photographs, and how they are read."""

    path: str | None = None
    """Folder of the dataset; usually given by --scene."""
    downscale: Annotated[float, Field(ge=1)] = 1
    """Divisor of the photographs' size."""
    levels: Annotated[int, Field(ge=1, le=8)] = 1
    """Number of sizes to train on: downscale, and twice, four times, … that."""
    alpha: Alpha = "transparency"
    """Fourth channel of photographs: blended with the background, or a mask of what counts."""
    background: Literal["auto", "black", "white"] = "auto"
    """Colour behind the scene; auto: white for Blender scenes, else black."""
    image_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of photographs on the device; without it, a quarter of its memory."""
    holdout: Annotated[int, Field(ge=0)] = 8
    """Every n-th image, by name, is a test view; 0: none."""

    @property
    def scales(self) -> tuple[float, ...]:
        """Divisors of the original photographs' size to train on, from the finest."""
        return tuple(self.downscale * 2**level for level in range(self.levels))

    @property
    def folder(self) -> Path:
        """Where the photographs lie.  Raises ConfigError when it was not given."""
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
    """Schedule of blending: wide for CPUs, simt for GPUs."""
    sort: Sort = "auto"
    """Way to order splats by tile and depth; auto: the faster one on the first frame."""
    pair_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of gradient records; without it, the largest buffer of the device."""
    launch_tiles: Annotated[int, Field(ge=0)] = 0
    """Tiles blended by one launch, for watchdogs of displays; 0: all."""

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
    """Name of the pipeline, and of its run folder."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of all random numbers."""
    scene: SceneSettings = SceneSettings()
    """Which photographs."""
    model: ModelSettings = ModelSettings()
    """How Gaussians are rendered."""
    rasterizer: RasterizerSettings = RasterizerSettings()
    """How the device works."""
    prepare: list[OneOf[Step]] = Field([])
    """Steps from photographs to a scene, each done once."""
    stages: Annotated[list[OneOf[Stage]], Field(min_length=1)]
    """What is done with the scene, in order."""
    plugins: dict[str, str] = Field(default={})
    """Plug-ins that the run was made with: name and sha256; written by a run, and then required."""

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
        return plan(settings.prepare, settings.scene.folder, prepared_beside(out)) if settings.prepare else []

    def resolved(self) -> dict[str, Any]:
        """Every setting with its value, as plain data in the shape of a file."""
        data = self.settings.model_dump(mode="json")
        data |= {key: [_untagged(stage) for stage in data[key]] for key in LISTS}
        return data if data["plugins"] else {key: value for key, value in data.items() if key != "plugins"}

    def text(self) -> str:
        """The resolved file."""
        stream = io.StringIO()
        yaml = YAML(typ="safe")
        yaml.default_flow_style = None
        yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
        yaml.width = 120
        yaml.dump(self.resolved(), stream)
        return stream.getvalue()


def prepared_beside(out: Path) -> Path:
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
    data = _tagged_file(Document(copy.deepcopy(document.data), document.lines), path)
    for override in overrides:
        _override(data, override)
    data = with_new_names(data, str(path))
    if isinstance(recorded := data.get("plugins"), dict):
        plugins.require({str(name): str(digest) for name, digest in recorded.items()}, str(path))
    try:
        settings = PipelineFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, PipelineFile, path, document)) from error
    _check_order(path, settings)
    return Pipeline(path, settings.model_copy(update={"plugins": plugins.used_by(settings)}))


def find(name: str) -> Path:
    """The file of a pipeline given by path or by the name of a shipped one."""
    path = Path(name)
    if path.is_file():
        return path
    if path.suffix in (".yaml", ".yml"):
        raise ConfigError(f"{path}: no such pipeline file")
    shipped = {file.stem: file for file in sorted(resource_dir("pipelines").glob("*.yaml"))}
    if name in shipped:
        return shipped[name]
    if path.is_dir():
        go_on = f"clsplat run PIPELINE --out {path} --resume"
        raise ConfigError(f"{path}: is a folder, expected a pipeline file; to go on with a run: {go_on}")
    near = difflib.get_close_matches(name, shipped, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(shipped)}, or give a path"
    raise ConfigError(f"no pipeline named '{name}'{hint}")


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


def _override(data: dict[str, Any], text: str) -> None:
    """Apply 'place.key=value'; a stage is addressed by its name, inside `during` as well when that is the only one."""
    place, equals, value = text.partition("=")
    names = re.findall(r"[^.\[\]]+", place)
    if not equals or len(names) < 1:
        raise ConfigError(f"--set {text}: expected stage.key=value, for example optimize.steps=500")
    node: Any = data
    for position, name in enumerate(names[:-1]):
        node = _descend(node, name, text, top=position == 0)
    if isinstance(node, list) and names[-1].isdigit() and int(names[-1]) < len(node):
        node[int(names[-1])] = parse_scalar(value)
    elif isinstance(node, dict):
        node[names[-1]] = parse_scalar(value)
    else:
        raise ConfigError(f"--set {text}: there is no '{names[-1]}' here")


def _descend(node: Any, name: str, text: str, top: bool) -> Any:
    if isinstance(node, list):
        if name.isdigit() and int(name) < len(node):
            return node[int(name)]
        raise ConfigError(f"--set {text}: '{name}' is not a place in a list of {len(node)}")
    if not isinstance(node, dict):
        raise ConfigError(f"--set {text}: nothing lies below '{name}'")
    stages = [stage for key in (LISTS if top else ("during",)) for stage in node.get(key, [])]
    found = [stage for stage in stages if stage["stage"] == name]
    if top and not found:
        found = [inner for stage in stages for inner in stage.get("during", []) if inner["stage"] == name]
    if len(found) > 1:
        raise ConfigError(f"--set {text}: there are {len(found)} stages named '{name}'; set the value in the file")
    if found:
        return found[0]
    if name in node:
        return node[name]
    if top and name not in PipelineFile.model_fields:
        known = [*PipelineFile.model_fields, *variants(Stage), *variants(Step)]
        near = difflib.get_close_matches(name, known, n=1)
        raise ConfigError(f"--set {text}: no '{name}' in this pipeline{f'; did you mean {near[0]}?' if near else ''}")
    node[name] = {}
    return node[name]


def _check_order(path: Path, settings: PipelineFile) -> None:
    """Every stage finds what it needs made before it."""
    made = {"scene"}
    for i, stage in enumerate(settings.stages):
        if isinstance(stage, Scheduled) and stage.every is not None:
            raise ConfigError(f"{path}: stages[{i}] {stage.stage}: 'every' belongs inside optimize.during")
        for need in sorted(stage.needs - made):
            makers = ", ".join(name for name, kind in variants(Stage).items() if need in kind.makes)
            raise ConfigError(
                f"{path}: stages[{i}] {stage.stage} needs '{need}', which no earlier stage makes ({makers} makes it)"
            )
        made |= stage.makes
