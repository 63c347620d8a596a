"""The rungs of the ladder: a model with fewer and fewer Gaussians, each trained from the one before."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, Interrupted
from clsplat.files import is_there
from clsplat.gaussians.model import Model
from clsplat.gaussians.run_model import MODEL
from clsplat.names import PIPELINE
from clsplat.opencl.device import Device
from clsplat.pipeline.files import find
from clsplat.pipeline.loading import Pipeline, checked, load
from clsplat.pipeline.yaml_file import Document, read_yaml
from clsplat.runs.experiment import run_pipeline
from clsplat.runs.source import Source
from clsplat.training.status import read_status

RECIPE = "compress"
STAGES = ("init", "prune_least", "optimize")  # of the recipe; what a rung writes is a PLY


@dataclass(frozen=True)
class Ladder:
    """Where rungs are trained, and with what."""

    out: Path
    source: Source
    model: Model  # the first rung
    steps: int | None  # of training after each pruning; None: those of the recipe
    device: Device

    def rung(self, keep: float, before: float) -> Path:
        """Prune from a share of the first model's Gaussians to another, and train; return the model's file.

        What an earlier call has finished is left alone, and what it has begun goes on.
        """
        if keep == 1:
            return self.source.file
        file = self.source.file if before == 1 else self.folder(before) / MODEL
        pipeline, folder = self.pipeline(file, keep / before), self.folder(keep)
        if not _is_done(pipeline, folder):
            try:
                run_pipeline(pipeline, folder, self.device, "resume" if is_there(folder) else "new")
            except Interrupted as error:
                raise Interrupted(f"stopped in {folder.name}; the same command goes on with the search") from error
        return folder / MODEL

    def folder(self, keep: float) -> Path:
        """Return the run folder of a rung."""
        return self.out / f"keep_{round(100 * keep):02d}"

    def pipeline(self, file: Path, keep: float) -> Pipeline:
        """Return the recipe as it is run: to prune a model file to a share of it."""
        path = find(RECIPE)
        data = read_yaml(path).data
        stages = [stage for stage in data["stages"] if isinstance(stage, dict) and next(iter(stage)) in STAGES]
        document = Document({**data, "stages": [*stages, {"export": {"file": MODEL}}]})
        values = {**self._scene(), **self._rendering(), "init.file": str(file.resolve()), "prune_least.keep": keep}
        if self.steps is not None:
            values |= {"optimize.steps": self.steps, "optimize.rates.means.over": self.steps}
        return checked(path, document, [f"{place}={json.dumps(value)}" for place, value in values.items()])

    def _scene(self) -> dict[str, Any]:
        settings, numbers = self.source.settings, self.model.rendering
        return {
            "scene.path": str(self.source.folder.resolve()),
            "scene.downscale": settings.downscale,
            "scene.holdout": settings.holdout,
            "scene.alpha": self.source.alpha or numbers.alpha,
            "scene.background": numbers.background or settings.background,
        }

    def _rendering(self) -> dict[str, Any]:
        numbers = self.model.rendering
        screen = {"type": "dilation", "variance": numbers.screen_variance, "compensate": int(numbers.compensate)}
        return {"model.sh_degree": self.model.sh_degree, "model.near": numbers.near, "model.screen_filter": screen}


def _is_done(pipeline: Pipeline, folder: Path) -> bool:
    """Whether a run folder holds the finished run of a pipeline."""
    if read_status(folder).get("state") != "done" or not (folder / MODEL).is_file():
        return False
    return load(str(folder / PIPELINE)).resolved() == pipeline.resolved()


def checked_keeps(keeps: Sequence[float]) -> list[float]:
    """Return shares of the Gaussians, from many to few.  Raises ConfigError for what is no share, and for none."""
    ordered = sorted(set(keeps), reverse=True)
    if not ordered or not all(0.01 <= keep <= 1 for keep in ordered):
        raise ConfigError("--keep: expected shares of the Gaussians from 0.01 to 1, such as 1,0.7,0.5")
    if len({round(100 * keep) for keep in ordered}) < len(ordered):
        raise ConfigError("--keep: expected shares that differ by a hundredth")
    return ordered


def of_degree(model: Model, degree: int) -> Model:
    """Return a model with harmonics up to a degree."""
    return replace(model, sh_rest=model.sh_rest[:, : 3 * ((degree + 1) ** 2 - 1)])
