"""Build levels of detail of a model: merge Gaussians level by level, and fine-tune them if there are photos."""

import logging
import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, pluralize
from clsplat.core.files import new_folder, require_free
from clsplat.core.reading import sha256
from clsplat.core.text_table import text_table
from clsplat.formats.splats import require_in_range, require_static
from clsplat.formats.streamed_sog import LOD_META, write_lod
from clsplat.formats.table import model_bytes, model_file
from clsplat.gaussians.mixture import merge_neighbors
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.sky import sky_path, write_sky_file
from clsplat.runs.model_file import ModelFile, find_run, photo_folder
from clsplat.scene.detect import read_scene
from clsplat.workflows.finetune import Measurer, Tuning, claim_folder, require_steps

# Options and training of levels.

MAX_LEVELS = 12  # a million Gaussians halved 11 times are 500
STEPS = 500
STAGES = ("init", "optimize")  # of the recipe
RECORD = "lod.json"


@dataclass(frozen=True)
class LodPlan:
    """The options for building levels of detail."""

    levels: int = 4
    keep: float = 0.5  # fraction of the Gaussians of the previous level
    steps: int | None = None  # training steps per level; 0: no training; None: STEPS if there are photos
    downscale: float | None = None  # divisor of the image size in training; None: as the model was trained

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_LEVELS:
            raise ConfigError(f"--levels {self.levels}: expected 1 to {MAX_LEVELS}")
        if not 0.01 <= self.keep < 1:
            raise ConfigError(
                f"--keep {self.keep:g}: expected a fraction of the Gaussians from 0.01 to below 1, such as 0.5"
            )
        if self.steps:
            require_steps(self.steps)
        if self.downscale is not None and not 1 <= self.downscale < math.inf:
            raise ConfigError(f"--downscale {self.downscale:g}: expected a divisor of at least 1")
        if self.downscale is not None and self.steps == 0:
            raise ConfigError(f"--downscale {self.downscale:g}: needs training; set --steps above 0")


@dataclass(frozen=True)
class DetailLevel:
    """A level of detail.  If there are photos, it includes the PSNR in dB before quantization."""

    model: Model
    merged_psnr: float | None = None  # before training
    psnr: float | None = None


class LevelTrainer:
    """Fine-tunes levels on the photos of their scene, and measures them."""

    def __init__(self, model: ModelFile, folder: Path, plan: LodPlan) -> None:
        self.folder, self.plan, self.source = folder, plan, model.source
        self.steps = STEPS if plan.steps is None else plan.steps
        self.measurer = Measurer(model)
        self.tuning = Tuning("lod", model.source, model.gaussians, self.steps, model.device)

    def lock(self) -> AbstractContextManager[None]:
        """Return a context manager that locks the training folder if levels are trained."""
        if not self.steps or self.plan.levels == 1:
            return nullcontext()
        identity: dict[str, Any] = {"sha256": sha256(model_file(self.source.file)), "scene": str(self.source.folder)}
        identity |= {"keep": self.plan.keep, "steps": self.steps, "downscale": self.plan.downscale}
        identity["photographs"] = self.measurer.identity()
        return claim_folder(self.folder, identity, RECORD, "the training of levels", "the name of another folder")

    def measure(self, model: Model) -> DetailLevel:
        """Measure the PSNR of a level without training it."""
        psnr = self.measurer.mean_metrics(model)[0]
        return DetailLevel(model, psnr, psnr)

    def train(self, number: int, model: Model) -> DetailLevel:
        """Fine-tune a level, unless `steps` is 0, and measure its PSNR before and after training."""
        merged_level = self.measure(model)
        if not self.steps:
            return merged_level
        file = self.folder / f"level_{number}.ply"
        model.save(file)
        size = {"scene.downscale": self.plan.downscale} if self.plan.downscale else {}
        pipeline = self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), **size})
        trained_model = load(self.tuning.train(pipeline, self.folder / f"level_{number}"))
        return DetailLevel(trained_model, merged_level.psnr, self.measure(trained_model).psnr)


def decimate(model: Model, keep: float = 0.5) -> Model:
    """Reduce a model to a fraction of its Gaussians, at least one, by merging neighbors.

    The world filter is baked into the result.  Raises ConfigError for an invalid fraction, and DataError for values
    that are not finite.
    """
    if not 0 < keep <= 1:
        raise ConfigError(f"--keep {keep:g}: expected a fraction of the Gaussians above 0, up to 1")
    return merge_neighbors(model, max(1, int(keep * len(model) + 0.5)))


LOG = logging.getLogger("clsplat")
MIN_GAUSSIANS = 1_000_000  # below this, PlayCanvas recommends a single SOG


def build_levels(
    model: Path, folder: Path, scene: Path | None = None, plan: LodPlan | None = None, device: Any = None
) -> dict[str, Any]:
    """Write levels of detail as streamed SOG.  Returns `folder`, its `bytes`, the measured `split`, and `levels`.

    If there are photos, each coarser level is trained before the next one is merged from it.  The run folders are in
    FOLDER.training, and interrupted training resumes.  Raises ConfigError, DataError, OutputError.
    """
    plan = plan or LodPlan()
    require_free(folder)
    photo_model, gaussians = _open_model(model, scene, plan, device)
    if not len(gaussians):
        raise DataError(f"{model}: the model has no Gaussians to merge; export it again")
    require_static(model, gaussians.to_splat_file(), "SOG")
    require_in_range(model, gaussians.to_splat_file(), "SOG")
    if len(gaussians) < MIN_GAUSSIANS:
        count = pluralize(len(gaussians), "Gaussian")
        LOG.warning("%s: has only %s; below a million, a single SOG is better: use `clsplat convert`", model, count)
    trainer = LevelTrainer(photo_model, folder.with_name(f"{folder.name}.training"), plan) if photo_model else None
    with new_folder(folder) as temporary_folder:
        with trainer.lock() if trainer else nullcontext():
            levels = _decimate_repeatedly(gaussians, plan, trainer)
        digest = write_lod(temporary_folder, [level.model.to_splat_file() for level in levels])
        write_sky_file(gaussians.sky, temporary_folder / LOD_META, digest)
    if gaussians.sky:
        name = sky_path(folder / LOD_META).name
        LOG.info("%s: the sky of the finest level is in %s; only clsplat renders it", folder, name)
    return {
        "folder": str(folder),
        "bytes": model_bytes(folder),
        "split": trainer.measurer.split if trainer else None,
        "levels": [_level_record(folder, number, level) for number, level in enumerate(levels)],
    }


def _open_model(model: Path, scene: Path | None, plan: LodPlan, device: Any) -> tuple[ModelFile | None, Model]:
    """Return the model file with its photos, and its Gaussians with the world filter baked in.

    If the photos are unknown or cannot be read, the first value is None.
    """
    run = find_run(model) if scene is None else None
    if scene is None and run is None:
        gaussians = _without_photos(model, plan, device, "its photos are unknown")
        LOG.info("%s: its photos are unknown, so levels are merged without training", model)
        return None, gaussians
    try:
        photo_model = ModelFile(model, scene, device)
    except DataError as error:
        if run is None or (photo_error := _photo_error(run)) is None:
            raise
        if plan.steps != 0:
            raise DataError(f"{photo_error} (pass --scene DIR, or --steps 0 to merge without photos)") from error
        gaussians = _without_photos(model, plan, device, "its photos cannot be read")
        LOG.warning("%s; levels are merged without training, and are not evaluated", photo_error)
        return None, gaussians
    return photo_model, photo_model.gaussians.baked()


def _without_photos(model: Path, plan: LodPlan, device: Any, reason: str) -> Model:
    """Return the Gaussians of a model without photos.  Raises ConfigError for options that need photos."""
    gaussians = load(model).baked()
    options = {"--steps": plan.steps, "--downscale": plan.downscale, "--device": device}
    if names := ", ".join(name for name, value in options.items() if value):
        raise ConfigError(f"{model}: {reason}, so {names} cannot be used; pass --scene, or omit {names}")
    return gaussians


def _photo_error(run: Path) -> DataError | None:
    """Return the error that reading the photos of a run raises, or None if it succeeds."""
    try:
        read_scene(photo_folder(run))
    except DataError as error:
        return error
    return None


def _decimate_repeatedly(gaussians: Model, plan: LodPlan, trainer: LevelTrainer | None) -> list[DetailLevel]:
    """Return all levels, the finest first.  If there is a trainer, it trains and measures them."""
    levels = [trainer.measure(gaussians) if trainer else DetailLevel(gaussians)]
    for number in range(1, plan.levels):
        model = decimate(levels[-1].model, plan.keep)
        LOG.info("level %d: %s", number, pluralize(len(model), "Gaussian"))
        levels.append(trainer.train(number, model) if trainer else DetailLevel(model))
    return levels


def _level_record(folder: Path, number: int, level: DetailLevel) -> dict[str, Any]:
    """Return the record of a written level: its number, Gaussians, bytes, and PSNR."""
    size = sum(file.stat().st_size for file in folder.glob(f"{number}_*/*"))
    record = {"level": number, "gaussians": len(level.model), "bytes": size}
    return {**record, "merged_psnr": level.merged_psnr, "psnr": level.psnr}


# A text table of levels of detail.

HEADINGS = ("level", "Gaussians", "MB", "PSNR, dB", "before training")


def format_table(result: dict[str, Any]) -> str:
    """Format the result of `build_levels` as text."""
    columns = len(HEADINGS) if result["split"] else 3
    return text_table([HEADINGS[:columns], *(_cells(level)[:columns] for level in result["levels"])])


def _cells(level: dict[str, Any]) -> list[str]:
    size, psnr = f"{level['bytes'] / 1e6:.3g}", [level["psnr"], level["merged_psnr"]]
    return [str(level["level"]), f"{level['gaussians']:,}", size, *("" if db is None else f"{db:.2f}" for db in psnr)]
