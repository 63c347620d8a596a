"""Levels of detail of a model: each merged from the one before, trained where photographs are there, and written."""

import logging
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, DataError, amount
from clsplat.files import new_folder, require_free
from clsplat.formats.lod import LOD_META
from clsplat.formats.lod_writing import write_lod
from clsplat.formats.model_files import bytes_of
from clsplat.formats.splats import require_moderate, require_still
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.sky import keep_sky, sky_file
from clsplat.lod.decimation import decimated
from clsplat.lod.training import Level, Plan, Training
from clsplat.runs.model_file import ModelFile
from clsplat.runs.source import photographs_of, run_of
from clsplat.scene.detect import read_scene

LOG = logging.getLogger("clsplat")
FEW = 1_000_000  # Gaussians, below which PlayCanvas advises one SOG


def levels_of_detail(
    model: Path, folder: Path, scene: Path | None = None, plan: Plan | None = None, device: Any = None
) -> dict[str, Any]:
    """Write the levels of a model as streamed SOG; return its `folder`, `bytes`, the `split` measured, and `levels`.

    Where photographs are known, each coarser level is trained before the next one is merged from it, in run folders in
    FOLDER.training: what was interrupted goes on.  Raises ConfigError, DataError, OutputError.
    """
    plan = plan or Plan()
    require_free(folder)
    opened, first = _opened(model, scene, plan, device)
    if not len(first):
        raise DataError(f"{model}: the model holds no Gaussians; expected some to merge")
    require_still(model, first.as_file(), "SOG")
    require_moderate(model, first.as_file(), "SOG")
    if len(first) < FEW:
        told = amount(len(first), "Gaussian")
        LOG.warning("%s: has %s; below a million one SOG is better: `clsplat convert`", model, told)
    training = Training(opened, folder.with_name(f"{folder.name}.training"), plan) if opened else None
    with new_folder(folder) as place:
        with training.held() if training else nullcontext():
            levels = _levels(first, plan, training)
        digest = write_lod(place, [level.model.as_file() for level in levels])
        keep_sky(first.sky, place / LOD_META, digest)
    if first.sky:
        told = sky_file(folder / LOD_META).name
        LOG.info("%s: the sky of the finest level is in %s, which clsplat alone draws", folder, told)
    return {
        "folder": str(folder),
        "bytes": bytes_of(folder),
        "split": training.measurer.split if training else None,
        "levels": [_figures(folder, number, level) for number, level in enumerate(levels)],
    }


def _opened(model: Path, scene: Path | None, plan: Plan, device: Any) -> tuple[ModelFile | None, Model]:
    """The model with its photographs, or alone where there are none, and its Gaussians."""
    run = run_of(model) if scene is None else None
    if scene is None and run is None:
        alone = _alone(model, plan, device, "no photographs are known")
        LOG.info("%s: no photographs: merged alone", model)
        return None, alone
    try:
        opened = ModelFile(model, scene, device)
    except DataError as error:
        if run is None or (fault := _fault_of_photographs(run)) is None:
            raise
        if plan.steps != 0:
            raise DataError(f"{fault} (--scene DIR names another; --steps 0 needs none)") from error
        alone = _alone(model, plan, device, "its photographs cannot be read")
        LOG.warning("%s; levels are merged alone, and not measured", fault)
        return None, alone
    return opened, opened.gaussians.baked()


def _alone(model: Path, plan: Plan, device: Any, why: str) -> Model:
    """The Gaussians of a model without photographs.  Raises ConfigError for what needs them."""
    alone = load(model).baked()
    given = {"--steps": plan.steps, "--downscale": plan.downscale, "--device": device}
    if names := ", ".join(name for name, value in given.items() if value):
        raise ConfigError(f"{model}: {why}, needed for {names}; give --scene, or leave that out")
    return alone


def _fault_of_photographs(run: Path) -> DataError | None:
    """Why those of a run cannot be read."""
    try:
        read_scene(photographs_of(run))
    except DataError as error:
        return error
    return None


def _levels(first: Model, plan: Plan, training: Training | None) -> list[Level]:
    levels = [training.measured(first) if training else Level(first)]
    for number in range(1, plan.levels):
        fewer = decimated(levels[-1].model, plan.keep)
        LOG.info("level %d: %s", number, amount(len(fewer), "Gaussian"))
        levels.append(training.trained(number, fewer) if training else Level(fewer))
    return levels


def _figures(folder: Path, number: int, level: Level) -> dict[str, Any]:
    """Counts, size and PSNR of a level that was written."""
    size = sum(file.stat().st_size for file in folder.glob(f"{number}_*/*"))
    figures = {"level": number, "gaussians": len(level.model), "bytes": size}
    return {**figures, "merged_psnr": level.merged_psnr, "psnr": level.psnr}
