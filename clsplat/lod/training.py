"""The training of levels: what is asked for, and run folders beside the folder of the levels."""

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError
from clsplat.formats.model_files import located
from clsplat.gaussians.model import Model, load
from clsplat.reading import sha256
from clsplat.runs.model_file import ModelFile
from clsplat.tuning.folder import claimed
from clsplat.tuning.measuring import Measurer
from clsplat.tuning.tuning import Tuning, require_steps

MOST = 12  # levels; halves of a million Gaussians are 500 then
STEPS = 500
STAGES = ("init", "optimize", "take_average")  # of the recipe
RECORD = "lod.json"


@dataclass(frozen=True)
class Plan:
    """What is asked for."""

    levels: int = 4
    keep: float = 0.5  # share of the Gaussians of the level before
    steps: int | None = None  # of training each level; 0: none; None: STEPS where there are photographs
    downscale: float | None = None  # divisor of their size in this training; None: as the model was trained

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MOST:
            raise ConfigError(f"--levels {self.levels}: expected 1 to {MOST}")
        if not 0.01 <= self.keep < 1:
            raise ConfigError(
                f"--keep {self.keep:g}: expected a share of the Gaussians from 0.01 to below 1, such as 0.5"
            )
        if self.steps:
            require_steps(self.steps)
        if self.downscale is not None and not 1 <= self.downscale < math.inf:
            raise ConfigError(f"--downscale {self.downscale:g}: expected a divisor of at least 1")
        if self.downscale is not None and self.steps == 0:
            raise ConfigError(f"--downscale {self.downscale:g}: belongs to a training; expected --steps above 0")


@dataclass(frozen=True)
class Level:
    """One level; PSNR in dB, before it is quantised, where there are photographs."""

    model: Model
    merged_psnr: float | None = None  # before it was trained
    psnr: float | None = None


class Training:
    """Trains and measures levels."""

    def __init__(self, opened: ModelFile, place: Path, plan: Plan) -> None:
        self.place, self.plan, self.source = place, plan, opened.source
        self.steps = STEPS if plan.steps is None else plan.steps
        self.measurer = Measurer(opened)
        self.tuning = Tuning("lod", opened.source, opened.gaussians, self.steps, opened.device)

    def held(self) -> AbstractContextManager[None]:
        """Hold the folder of the training in a block, where anything is trained."""
        if not self.steps or self.plan.levels == 1:
            return nullcontext()
        question: dict[str, Any] = {"sha256": sha256(located(self.source.file)), "scene": str(self.source.folder)}
        question |= {"keep": self.plan.keep, "steps": self.steps, "downscale": self.plan.downscale}
        question["photographs"] = self.measurer.identity()
        return claimed(self.place, question, RECORD, "the training of levels", "the name of another folder")

    def measured(self, model: Model) -> Level:
        """Return a level that is not trained."""
        psnr = self.measurer.figures(model)[0]
        return Level(model, psnr, psnr)

    def trained(self, number: int, model: Model) -> Level:
        """Return a level after its training."""
        merged = self.measured(model)
        if not self.steps:
            return merged
        file = self.place / f"level_{number}.ply"
        model.save(file)
        size = {"scene.downscale": self.plan.downscale} if self.plan.downscale else {}
        pipeline = self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), **size})
        found = load(self.tuning.trained(pipeline, self.place / f"level_{number}"))
        return Level(found, merged.psnr, self.measured(found).psnr)
