"""Metrics of a split."""

import logging
from dataclasses import asdict
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.stages.base import Stage
from clsplat.training.metrics import mean, measure
from clsplat.training.run import Run
from clsplat.training.targets import Targets

LOG = logging.getLogger("clsplat")


class Evaluate(Stage):
    """Render the views of a split and compare them, as 8-bit images, with the photographs."""

    stage: Literal["evaluate"] = "evaluate"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"metrics"})

    split: Literal["test", "train"] = "test"
    scales: Annotated[list[int], Field(min_length=1)] = Field([1])  # downscale factors, on top of the scene's

    def run(self, run: Run) -> None:
        scene = run.scene
        if not scene.split(self.split):
            LOG.warning("no %s views: nothing to evaluate (scene.holdout chooses them)", self.split)
            return
        for scale in self.scales:
            views = scene.downscaled(scale).split(self.split)
            targets = run.targets if scale == 1 else Targets(run.device, run.targets.background_name)
            results = measure(run.renderer, run.trained, views, targets)
            for result in results:
                run.records.add(run.step, "view", split=self.split, scale=scale, **asdict(result))
            averages = mean(results)
            run.records.add(run.step, "evaluate", split=self.split, scale=scale, **averages)
            run.metrics.setdefault(self.split, {})[str(scale)] = averages
            LOG.info(
                "step %d  %s views at 1/%d: PSNR %.2f dB  SSIM %.4f  (%d views)",
                *(run.step, self.split, scale, averages["psnr"], averages["ssim"], len(results)),
            )
