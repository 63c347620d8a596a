"""A model file trained further, from the photographs of its scene: stages of the recipe `compress`, as runs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.errors import Interrupted
from clsplat.files import is_there
from clsplat.gaussians.model import Model
from clsplat.gaussians.run_model import MODEL
from clsplat.opencl.device import Device
from clsplat.pipeline.files import find
from clsplat.pipeline.loading import Pipeline, checked
from clsplat.pipeline.yaml_file import Document, read_yaml
from clsplat.runs.folders import Start
from clsplat.runs.found import changed, is_done_with
from clsplat.runs.single import run_pipeline
from clsplat.runs.source import Source
from clsplat.training import checkpoint

RECIPE, TRAINING = "compress", "optimize"


@dataclass(frozen=True)
class Tuning:
    """With which photographs models are trained, as one is rendered, and how long."""

    name: str  # of the pipelines that are run
    source: Source
    model: Model
    steps: int | None  # None: those of the recipe
    device: Device

    def pipeline(self, stages: Sequence[str], values: Mapping[str, Any], **export: str) -> Pipeline:
        """Return stages of the recipe, in its order, and one that writes the model, with other values by place."""
        path = find(RECIPE)
        data = read_yaml(path).data
        left = iter(data["stages"])
        chosen = [next(stage for stage in left if _is(stage, name)) for name in stages]
        document = Document({**data, "name": self.name, "stages": [*chosen, {"export": {"file": MODEL, **export}}]})
        settings = {**self._scene(), **self._rendering(), **values}
        if self.steps is not None:
            first = next(stage for stage in data["stages"] if _is(stage, TRAINING))[TRAINING]["steps"]
            for place, stage in enumerate(chosen):
                if _is(stage, TRAINING):
                    steps = max(1, round(self.steps * stage[TRAINING]["steps"] / first))
                    settings |= {f"stages.{place}.steps": steps, f"stages.{place}.rates.means.over": steps}
        return checked(path, document, [f"{place}={json.dumps(value)}" for place, value in settings.items()])

    def trained(self, pipeline: Pipeline, folder: Path, file: str = MODEL) -> Path:
        """Run a pipeline in a folder; return the file that it writes there.

        What an earlier call has finished is left alone, what it has begun goes on, and what was lost is made again.
        """
        if not is_done_with(pipeline, folder) or changed(folder):
            begun: Start = "resume" if checkpoint.saved(folder) else "restart"
            start: Start = begun if is_there(folder) else "new"
            try:
                run_pipeline(pipeline, folder, self.device, start)
            except Interrupted as error:
                raise Interrupted(f"stopped in {folder.name}; the same command goes on") from error
        return folder / file

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
        if numbers.pixel_box:
            screen = {"type": "box"}
        sky = self.model.sky and {"type": "directions", "side": self.model.sky.side}
        return {
            "model.sh_degree": self.model.sh_degree,
            "model.near": numbers.near,
            "model.screen_filter": screen,
            **({"model.background": sky} if sky else {}),
        }


def _is(stage: Any, name: str) -> bool:
    """Whether a stage of a file, which is its name where it has no settings, has this name."""
    return bool(stage == name or (isinstance(stage, dict) and name in stage))
