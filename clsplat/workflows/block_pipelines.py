"""The pipeline of a block, and that of the merged model: parts of one file, with other settings."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import divide, schedule_values
from clsplat.gaussians.model import MODEL
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline, checked
from clsplat.pipeline.stretching import map_trainings, stretched
from clsplat.pipeline.yaml_file import Document
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.training.stage import Stage
from clsplat.workflows.partition import Block


def require_divisible(pipeline: Pipeline) -> None:
    """Raise ConfigError for a pipeline whose blocks would not fit together, or that does not start from a model."""
    settings, first = pipeline.settings, pipeline.stages[0]
    trainings = [stage for stage in pipeline.stages if isinstance(stage, Optimize)]
    faults = {
        "prepare": (settings.prepare, "run it first, and give the folder of that run as --scene"),
        "adapt": (settings.adapt, "each block would decide by its own photographs; write the settings out"),
        "model.time": (settings.model.time, "a cell holds Gaussians at their own time, not at all times; leave it out"),
        "model.background": (settings.model.background, "each block would learn its own sky; leave it out"),
        "scene.levels": (settings.scene.levels > 1, "a block has views of one size; set it to 1"),
        "scene.train": (settings.scene.train, "blocks choose their views; leave it out"),
        "scene.validation": (settings.scene.validation != 0, "a block has no views to choose by; set it to 0"),
        "scene.extent": (settings.scene.extent, "blocks have that of the whole scene; leave it out"),
        "optimize.modules": (
            any("blocks" in one.conflicts for stage in trainings for one in stage.modules),
            "some would differ from block to block; leave them out",
        ),
        "densify.budget": (
            any(getattr(one.budget, "gaussians", None) for one in _densities(pipeline.stages)),
            "it counts the Gaussians of the whole; give densify.max_gaussians, which blocks share",
        ),
        "densify.per_pixel": (
            any(one.per_pixel for one in _densities(pipeline.stages)),
            "photographs of blocks differ; give densify.max_gaussians, which blocks share",
        ),
        "densify.inside": (any(one.inside for one in _densities(pipeline.stages)), "blocks set it; leave it out"),
    }
    for key, (is_set, remedy) in faults.items():
        if is_set:
            raise ConfigError(f"{pipeline.path}: {key} is not for blocks: {remedy}")
    if not (isinstance(first, Init) and first.source == "model" and trainings):
        raise ConfigError(f"{pipeline.path}: expected `init: {{source: model}}` first, and a stage 'optimize'")


def block_pipeline(
    pipeline: Pipeline, block: Block, start: Path, extent: float, share: Fraction = Fraction(1)
) -> Pipeline:
    """Return the training of a block from its first Gaussians, up to its model, cropped to its cell.

    extent: of the whole scene; share: of the pipeline's steps that are trained, with the rates of `_shared`.
    """
    data, last, cell = pipeline.resolved(), _last(pipeline), block.box.model_dump()
    stages = [_growing(stage, block) for stage in _starting(data["stages"][:last], start)]
    names = [view["name"] for view in block.views]
    scene = {**data["scene"], "holdout": 0, "train": {"names": names}, "extent": extent}
    changed = {**data, "name": f"{pipeline.settings.name}_{block.name}", "scene": scene}
    changed["stages"] = [*stages, {"crop": {"inside": cell}}, {"export": {"file": MODEL}}]
    found = checked(pipeline.path, Document(changed))
    return found if share == 1 else replace(found, settings=_shared(found.settings, share))


def merged_pipeline(pipeline: Pipeline, file: Path) -> Pipeline:
    """Return what comes after the training, for the merged model: it is measured, exported, shown."""
    data, last = pipeline.resolved(), _last(pipeline)
    stages = [*_starting(data["stages"][:1], file), *(data["stages"][last:] or [{"export": {"file": MODEL}}])]
    return checked(pipeline.path, Document({**data, "stages": stages}))


def coarse_pipeline(coarse: Pipeline, pipeline: Pipeline) -> Pipeline:
    """Return the pipeline of the coarse model with the photographs, filters and seed of that of the blocks."""
    data = pipeline.resolved()
    same = {key: data[key] for key in ("scene", "model", "rasterizer", "seed") if key in data}
    return checked(coarse.path, Document({**coarse.resolved(), **same}))


def without_start(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without the file of its first model."""
    first, *others = pipeline.stages
    stages = [first.model_copy(update={"file": None}), *others]
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"stages": stages}))


def _shared(settings: PipelineFile, share: Fraction) -> PipelineFile:
    """Settings with a share of the steps, and rates that are larger as its root is smaller.

    Adam divides by the root of the mean square of gradients over steps.  Where a share p of the views show a
    Gaussian, it has gradients in that share of the steps, and each moves it as 1 / √p.  In a block p is larger by
    1 / share.
    """

    def changed(training: Optimize) -> Optimize:
        if training.update != "all":  # rows that are not seen keep their moments
            return training
        return training.model_copy(update={"rates": training.rates.times(float(share) ** -0.5)})

    return map_trainings(stretched(settings, share), Optimize, changed)


def _last(pipeline: Pipeline) -> int:
    """The number of stages up to the last that changes the model."""
    return max(i for i, stage in enumerate(pipeline.stages, 1) if stage.edits or isinstance(stage, Optimize))


def _densities(stages: Iterable[Stage]) -> Iterator[Densify]:
    for stage in stages:
        yield from (one for one in (stage, *getattr(stage, "during", ())) if isinstance(one, Densify))


def _starting(stages: list[Any], file: Path) -> list[Any]:
    """Stages of a resolved file whose first, `init`, reads this model."""
    first, *others = stages
    return [{"init": {**first["init"], "file": str(file.resolve())}}, *others]


def _growing(stage: dict[str, Any], block: Block) -> dict[str, Any]:
    """A stage of a resolved file that lets Gaussians grow in a block alone, up to its part of their number."""
    ((name, fields),) = stage.items()
    if name == "densify":
        limited = _limited(Densify.model_validate(fields), block).model_dump(mode="json")
        return {name: {key: limited[key] for key in fields}}
    if "during" in fields:
        return {name: {**fields, "during": [_growing(inner, block) for inner in fields["during"]]}}
    return stage


def _limited(densify: Densify, block: Block) -> Densify:
    """The stage in a block: Gaussians grow in its cell, up to its share, by pairs, of the number of the whole."""
    changed: dict[str, Any] = {"inside": block.growth}
    if densify.max_gaussians is not None:
        changed["max_gaussians"] = divide(densify.max_gaussians, 1 / block.pairs)
        if min(schedule_values(changed["max_gaussians"])) < 1:
            told = f"densify.max_gaussians: {block.name} has none of so few Gaussians"
            raise ConfigError(f"{told}; expected more of them, or fewer --blocks")
    return densify.model_copy(update=changed)
