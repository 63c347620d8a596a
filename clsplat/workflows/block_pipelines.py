"""Derive the pipelines of blocks, of the merged model, and of the coarse model from one pipeline."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import divide, schedule_values
from clsplat.gaussians.model import MODEL
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline, check_document
from clsplat.pipeline.stretching import map_trainings, stretch
from clsplat.pipeline.yaml_file import Document
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.training.stage import Stage
from clsplat.workflows.partition import Block


def require_divisible(pipeline: Pipeline) -> None:
    """Raise ConfigError if a pipeline has settings that would differ between blocks, or does not start from a model."""
    settings, first_stage = pipeline.settings, pipeline.stages[0]
    optimize_stages = [stage for stage in pipeline.stages if isinstance(stage, Optimize)]
    modules = [module for stage in optimize_stages for module in stage.modules if "blocks" in module.conflicts]
    faults = {
        "prepare": (settings.prepare, "run these steps first, and pass their run folder as --scene"),
        "adapt": (settings.adapt, "each block would adapt its settings to its photos; write the settings explicitly"),
        "model.time": (settings.model.time, "moving Gaussians leave their cells; leave it out"),
        "model.background": (settings.model.background, "each block would learn its own sky; leave it out"),
        "scene.levels": (settings.scene.levels > 1, "a block uses views of one size; set it to 1"),
        "scene.train": (settings.scene.train, "blocks choose their views; leave it out"),
        "scene.validation": (settings.scene.validation != 0, "a block has no validation views; set it to 0"),
        "scene.extent": (settings.scene.extent, "blocks use the extent of the whole scene; leave it out"),
        "optimize.modules": (
            modules,
            f"{', '.join(module.type for module in modules)} would differ between blocks; leave such modules out",
        ),
        "densify.budget": (
            any(getattr(stage.budget, "gaussians", None) for stage in _densify_stages(pipeline.stages)),
            "it limits the whole scene; use densify.max_gaussians, which is split between blocks",
        ),
        "densify.inside": (
            any(stage.inside for stage in _densify_stages(pipeline.stages)),
            "each block sets it; leave it out",
        ),
    }
    for key, (is_set, remedy) in faults.items():
        if is_set:
            raise ConfigError(f"{pipeline.path}: {key} cannot be used with blocks: {remedy}")
    if not (isinstance(first_stage, Init) and first_stage.source == "model" and optimize_stages):
        raise ConfigError(f"{pipeline.path}: expected `init: {{source: model}}` first, and an 'optimize' stage")


def block_pipeline(
    pipeline: Pipeline, block: Block, start: Path, extent: float, fraction: Fraction = Fraction(1)
) -> Pipeline:
    """Return the pipeline of a block: from its initial Gaussians to its model, cropped to its cell.

    start: file of the initial Gaussians; extent: of the full scene, in scene units; fraction: of the training steps,
    with learning rates as in `_with_fewer_steps`.
    """
    data, stage_count, cell = pipeline.resolved_settings(), _count_until_last_edit(pipeline), block.box.model_dump()
    stages = [_limit_growth(stage, block) for stage in _with_start(data["stages"][:stage_count], start)]
    names = [view["name"] for view in block.views]
    scene = {**data["scene"], "holdout": 0, "train": {"names": names}, "extent": extent}
    document = {**data, "name": f"{pipeline.settings.name}_{block.name}", "scene": scene}
    document["stages"] = [*stages, {"crop": {"inside": cell}}, {"export": {"file": MODEL}}]
    result = check_document(pipeline.path, Document(document))
    return result if fraction == 1 else replace(result, settings=_with_fewer_steps(result.settings, fraction))


def merged_pipeline(pipeline: Pipeline, file: Path) -> Pipeline:
    """Return a pipeline that starts from the merged model and runs the stages after training, or only an export."""
    data, stage_count = pipeline.resolved_settings(), _count_until_last_edit(pipeline)
    stages = [*_with_start(data["stages"][:1], file), *(data["stages"][stage_count:] or [{"export": {"file": MODEL}}])]
    return check_document(pipeline.path, Document({**data, "stages": stages}))


def coarse_pipeline(coarse: Pipeline, pipeline: Pipeline) -> Pipeline:
    """Return the pipeline of the coarse model with the scene, filters, and seed of the block pipeline."""
    data = pipeline.resolved_settings()
    settings = {key: data[key] for key in ("scene", "model", "rasterizer", "seed") if key in data}
    return check_document(coarse.path, Document({**coarse.resolved_settings(), **settings}))


def without_start(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without the path of its initial model."""
    first, *others = pipeline.stages
    stages = [first.model_copy(update={"file": None}), *others]
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"stages": stages}))


def _with_fewer_steps(settings: PipelineFile, fraction: Fraction) -> PipelineFile:
    """Return settings with a fraction of the steps, and with learning rates divided by the square root of the fraction.

    Adam divides gradients by their RMS over steps.  A Gaussian visible in a fraction p of the views has gradients in
    that fraction of the steps, and each step moves it in proportion to 1 / √p.  In a block, p is 1 / fraction times as
    large.
    """

    def with_rates(training: Optimize) -> Optimize:
        if training.update != "all":  # Gaussians outside the view keep their moments
            return training
        return training.model_copy(update={"rates": training.rates.scale(float(fraction) ** -0.5)})

    return map_trainings(stretch(settings, fraction), Optimize, with_rates)


def _count_until_last_edit(pipeline: Pipeline) -> int:
    """Return the number of stages up to and including the last one that changes the model."""
    return max(i for i, stage in enumerate(pipeline.stages, 1) if stage.edits or isinstance(stage, Optimize))


def _densify_stages(stages: Iterable[Stage]) -> Iterator[Densify]:
    for stage in stages:
        yield from (inner for inner in (stage, *getattr(stage, "during", ())) if isinstance(inner, Densify))


def _with_start(stages: list[Any], file: Path) -> list[Any]:
    """Return the stages of a resolved pipeline with a model file as the input of `init`."""
    first, *others = stages
    return [{"init": {**first["init"], "file": str(file.resolve())}}, *others]


def _limit_growth(stage: dict[str, Any], block: Block) -> dict[str, Any]:
    """Return a stage of a resolved pipeline with its densification limited by `_limit_densify`."""
    ((name, fields),) = stage.items()
    if name == "densify":
        densify = _limit_densify(Densify.model_validate(fields), block).model_dump(mode="json")
        return {name: {key: densify[key] for key in fields}}
    if "during" in fields:
        return {name: {**fields, "during": [_limit_growth(inner, block) for inner in fields["during"]]}}
    return stage


def _limit_densify(densify: Densify, block: Block) -> Densify:
    """Return a densify stage limited to a block's growth box and to a share of the maximum number of Gaussians.

    The share is the block's fraction of all (tile, Gaussian) pairs.
    """
    updates: dict[str, Any] = {"inside": block.growth_box}
    if densify.max_gaussians is not None:
        updates["max_gaussians"] = divide(densify.max_gaussians, 1 / block.pairs)
        if min(schedule_values(updates["max_gaussians"])) < 1:
            raise ConfigError(
                f"densify.max_gaussians: {block.name} gets no Gaussians; raise the limit, or use fewer --blocks"
            )
    return densify.model_copy(update=updates)
