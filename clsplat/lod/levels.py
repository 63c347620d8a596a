"""Levels of detail of a model: each merged from the one before, trained where photographs are there, and measured."""

import logging
import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.compress.folder import claimed
from clsplat.compress.search import Measurer
from clsplat.compress.tuning import Tuning
from clsplat.errors import ConfigError, DataError
from clsplat.formats.lod_writing import require_free, write_lod
from clsplat.formats.splats import Writing, require_moderate
from clsplat.formats.table import bytes_of, located
from clsplat.gaussians.clusters import DeviceClusters
from clsplat.gaussians.model import Model, load
from clsplat.lod.decimation import decimated
from clsplat.reading import sha256
from clsplat.runs.model_file import ModelFile
from clsplat.runs.source import run_of

LOG = logging.getLogger("clsplat")
MOST = 12  # levels; halves of a million Gaussians are 500 then
FEW = 1_000_000  # Gaussians, below which PlayCanvas advises one SOG
STAGES = ("init", "optimize")  # of the recipe
RECORD = "lod.json"


@dataclass(frozen=True)
class Plan:
    """What is asked for."""

    levels: int = 4
    keep: float = 0.5  # share of the Gaussians of the level before
    steps: int = 500  # of training each level where there are photographs; 0: none
    downscale: float | None = None  # divisor of their size in this training; None: as the model was trained

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MOST:
            raise ConfigError(f"--levels {self.levels}: expected 1 to {MOST}")
        if not 0.01 <= self.keep < 1:
            raise ConfigError(
                f"--keep {self.keep:g}: expected a share of the Gaussians from 0.01 to below 1, such as 0.5"
            )
        if self.downscale is not None and not 1 <= self.downscale < math.inf:
            raise ConfigError(f"--downscale {self.downscale:g}: expected a divisor of at least 1")
        if self.steps < 0:
            raise ConfigError(f"--steps {self.steps}: expected a number of at least 0")


@dataclass(frozen=True)
class Level:
    """One level; PSNR in dB, before it is quantised, where there are photographs."""

    model: Model
    merged_psnr: float | None = None  # before it was trained
    psnr: float | None = None


class Training:
    """Trains and measures levels, in run folders beside the folder of the levels."""

    def __init__(self, opened: ModelFile, place: Path, plan: Plan) -> None:
        self.place, self.plan = place, plan
        self.measurer = Measurer(opened)
        self.tuning = Tuning(opened.source, opened.loaded, plan.steps, opened.device)
        self.question: dict[str, Any] = {
            "sha256": sha256(located(opened.source.file)),
            "scene": str(opened.source.folder),
        }
        self.question |= {"keep": plan.keep, "steps": plan.steps, "downscale": plan.downscale}

    def held(self) -> AbstractContextManager[None]:
        """Hold the folder of the training in a block, where there is any."""
        if not self.plan.steps:
            return nullcontext()
        return claimed(self.place, self.question, RECORD, "the training of levels", "the name of another folder")

    def measured(self, model: Model) -> Level:
        """Return a level that is not trained."""
        psnr = self.measurer.figures(model)[0]
        return Level(model, psnr, psnr)

    def trained(self, number: int, model: Model) -> Level:
        """Return a level after its training."""
        merged = self.measured(model)
        if not self.plan.steps:
            return merged
        file = self.place / f"level_{number}.ply"
        model.save(file)
        size = {"scene.downscale": self.plan.downscale} if self.plan.downscale else {}
        pipeline = self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), **size})
        found = load(self.tuning.trained(pipeline, self.place / f"level_{number}"))
        return Level(found, merged.psnr, self.measured(found).psnr)


def levels_of_detail(
    model: Path, folder: Path, scene: Path | None = None, plan: Plan | None = None, device: Any = None
) -> dict[str, Any]:
    """Write the levels of a model as streamed SOG; return its `folder`, `bytes`, the `split` measured, and `levels`.

    Where photographs are known, each coarser level is trained before the next one is merged from it, in run folders in
    FOLDER.training: what was interrupted goes on.  Raises ConfigError, DataError, OutputError.
    """
    plan = plan or Plan()
    require_free(folder)
    opened = ModelFile(model, scene, device) if scene is not None or run_of(model) else None
    first = (opened.loaded if opened else load(model)).baked()
    if not len(first):
        raise DataError(f"{model}: the model holds no Gaussians; expected some to merge")
    require_moderate(model, first.as_file(), "SOG")
    if len(first) < FEW:
        LOG.warning("%s: has %d Gaussians; below a million one SOG is better: `clsplat convert`", model, len(first))
    training = Training(opened, folder.with_name(f"{folder.name}.training"), plan) if opened else None
    levels = [training.measured(first) if training else Level(first)]
    with training.held() if training else nullcontext():
        for number in range(1, plan.levels):
            fewer = decimated(levels[-1].model, plan.keep)
            LOG.info("level %d: %d Gaussians", number, len(fewer))
            levels.append(training.trained(number, fewer) if training else Level(fewer))
    writing = Writing(clustering=partial(DeviceClusters, opened.device)) if opened else Writing()
    write_lod(folder, [level.model.as_file() for level in levels], writing)
    return {
        "folder": str(folder),
        "bytes": bytes_of(folder),
        "split": training.measurer.split if training else None,
        "levels": [_figures(folder, number, level) for number, level in enumerate(levels)],
    }


def _figures(folder: Path, number: int, level: Level) -> dict[str, Any]:
    """Counts, size and PSNR of a level that was written."""
    size = sum(file.stat().st_size for file in folder.glob(f"{number}_*/*"))
    figures = {"level": number, "gaussians": len(level.model), "bytes": size}
    return {**figures, "merged_psnr": level.merged_psnr, "psnr": level.psnr}


def table(found: dict[str, Any]) -> str:
    """Return what `levels_of_detail` returns as lines of text."""
    headings = ["level", "Gaussians", "MB", "PSNR, dB", "before training"]
    rows = [
        [
            str(one["level"]),
            f"{one['gaussians']:,}",
            f"{one['bytes'] / 1e6:.3g}",
            _db(one["psnr"]),
            _db(one["merged_psnr"]),
        ]
        for one in found["levels"]
    ]
    used = len(headings) if found["split"] else 3
    widths = [max(len(row[i]) for row in (headings, *rows)) for i in range(used)]
    lines = (
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=False)) for row in (headings, *rows)
    )
    return "\n".join(lines)


def _db(psnr: float | None) -> str:
    return "–" if psnr is None else f"{psnr:.2f}"
