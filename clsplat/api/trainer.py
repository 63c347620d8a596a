"""A pipeline's training, step by step from Python."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat import plugins
from clsplat.api.device import default_device
from clsplat.errors import ConfigError
from clsplat.gaussians.model import Model, Rendering
from clsplat.gaussians.tables import PARAMETERS
from clsplat.losses.base import HostFunction, HostLoss, ViewGradients
from clsplat.metrics.views import mean, measure
from clsplat.opencl.device import Device
from clsplat.pipeline import load
from clsplat.runner import make_run
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.schedule import Schedule
from clsplat.stages.optimize import Optimize
from clsplat.training import checkpoint


@dataclass(frozen=True)
class Report:
    """One training step."""

    step: int  # global, counted from 1
    gaussians: int
    view: ViewGradients  # of this step; valid until the next

    @property
    def loss(self) -> float:
        """The sum of the losses; reading it waits for the device."""
        return self.view.loss

    def __repr__(self) -> str:
        return f"Report(step {self.step}, {self.gaussians:,} Gaussians)"


class Trainer:
    """Trains a scene as a pipeline says.

    Stages before the training are run at once; those after it, such as `evaluate` and `export`, are not run at all: use
    `evaluate` and `model`.  A trainer and `clsplat run` give the same bits.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        pipeline: str = "splat_7k",
        *,
        set: Mapping[str, Any] | None = None,
        device: Device | None = None,
        out: str | Path | None = None,
        resume: bool = False,
    ) -> None:
        """Prepare training.

        pipeline: a file, or the name of a shipped one; set: values by place, as of `--set`; out: folder for records and
        checkpoints, by default a temporary one; resume: go on from the newest checkpoint in `out`.
        Raises ConfigError, DataError and DeviceError.
        """
        plugins.load_installed()
        self.pipeline = load(pipeline, [f"{place}={json.dumps(value)}" for place, value in (set or {}).items()])
        if self.pipeline.settings.prepare:
            raise ConfigError(f"{self.pipeline.path}: prepares its scene; use clsplat.run, then train on the result")
        self.scene = (
            scene if isinstance(scene, Scene) else read_scene(Path(scene), self.pipeline.settings.scene.holdout)
        )
        self._folder = tempfile.TemporaryDirectory(prefix="clsplat-") if out is None else None
        folder = Path(out if out is not None else self._folder.name if self._folder else "")
        folder.mkdir(parents=True, exist_ok=True)
        self._run = make_run(self.pipeline, self.scene, device or default_device(), folder)
        resumed = resume and checkpoint.restore(self._run)
        self._run.records.start(self._run.step, edit_due=bool(resumed) and self._run.stage_step > 0)
        self._steps = self._iterate()
        self._before_training()

    def step(self) -> Report:
        """Train one step.  Raises StopIteration when the pipeline's steps are done."""
        view = next(self._steps)
        return Report(self._run.step, self._run.model.gaussians.count, view)

    def steps(self, count: int | None = None) -> Iterator[Report]:
        """Train step by step, as many as are given, or to the end of the pipeline's training."""
        done = 0
        while count is None or done < count:
            try:
                yield self.step()
            except StopIteration:
                return
            done += 1

    def run(self, count: int | None = None) -> Report | None:
        """Train so many steps, or to the end of the pipeline's training; return the last one."""
        report = None
        for report in self.steps(count):  # noqa: B007
            pass
        return report

    @property
    def model(self) -> Model:
        """A copy of the model as it is now."""
        run = self._run
        tables = {name: run.model.gaussians.get(name) for name in (*PARAMETERS, "filter_variance")}
        if not tables["filter_variance"].any():
            del tables["filter_variance"]
        return Model(**tables, rendering=Rendering.of(run.rendering(), "default"))

    def add_loss(self, function: HostFunction, weight: Schedule = 1.0) -> None:
        """Minimise also `function(image, photograph) -> (value, derivative by the image)`, in NumPy.

        Arrays are [height, width, 3] float32 in [0, 1].  Each step copies both images to the host and the derivative
        back; a plug-in with a kernel does not.
        """
        self._run.losses.append(HostLoss(function, weight))

    def evaluate(self, split: str = "test") -> dict[str, Any]:
        """Return the metrics of a split, with the keys of metrics.json; None for a split without views."""
        run = self._run
        views = run.scene.downscaled(run.downscale).split(split)
        return mean(measure(run.rasterizer, run.model, views, run.photographs)) if views else {"views": 0}

    def checkpoint(self) -> Path:
        """Save all that training needs to go on to the same bits; return the file."""
        return checkpoint.save(self._run, keep=2)

    def _before_training(self) -> None:
        """Run the stages up to the first that trains."""
        for cursor, stage in enumerate(self.pipeline.stages):
            if isinstance(stage, Optimize):
                return
            if cursor >= self._run.cursor:
                self._run.cursor = cursor
                stage.run(self._run)
        raise ConfigError(f"{self.pipeline.path}: expected a stage 'optimize'")

    def _iterate(self) -> Iterator[ViewGradients]:
        """All training stages, and those between them."""
        stages, run = self.pipeline.stages, self._run
        last = max(i for i, stage in enumerate(stages) if isinstance(stage, Optimize))
        first = next(i for i, stage in enumerate(stages) if isinstance(stage, Optimize))
        for cursor in range(max(first, run.cursor), last + 1):
            if cursor > run.cursor:
                run.cursor, run.stage_step = cursor, 0
            stage = stages[cursor]
            if isinstance(stage, Optimize):
                yield from stage.iterate(run)
            else:
                stage.run(run)

    def __repr__(self) -> str:
        return f"Trainer({self.pipeline.settings.name} on {self.scene.path.name}, step {self._run.step})"
