"""Measure the metrics of a split."""

import logging
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, field_validator

from clsplat.core.errors import pluralize
from clsplat.core.files import invalid_output_reason
from clsplat.core.settings import InputPath
from clsplat.gaussians.model import load
from clsplat.metrics.perceptual import InputRange, Metric, Perceptual
from clsplat.metrics.views import log_color_metrics, mean, measure
from clsplat.render.painter import Painter, SplatPainter
from clsplat.scene.view import sample_views
from clsplat.training.modules.base import color_model, learned_scene
from clsplat.training.run import Run
from clsplat.training.stage import CADENCE, Scheduled

LOG = logging.getLogger("clsplat")
Downscale = Annotated[float, Field(ge=1)]


def _check_output_path(text: str) -> str:
    if fault := invalid_output_reason(text):
        raise ValueError(f"cannot write to this path: {fault}; use another path inside the run folder")
    return text


class Evaluate(Scheduled):
    """Render the views of a split and compare them, as 8-bit images, with the photos.

    Each of `downscales` divides the original image size, not the training size: `downscales: [8, 4, 2, 1]` zooms into a
    scene that was trained at `downscale: 8`.  With `file`, the stage measures a file that an earlier `export` wrote, as
    viewers read it.
    """

    stage: Literal["evaluate"] = "evaluate"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    makes: ClassVar[frozenset[str]] = frozenset({"metrics"})
    output_keys: ClassVar[frozenset[str]] = CADENCE | {
        "split",
        "max_views",
        "downscales",
        "metrics",
        "lpips",
        "lpips_input",
        "file",
    }

    split: Literal["test", "train", "validation"] = "test"
    """Views to measure."""
    max_views: Annotated[int, Field(gt=0)] | None = None
    """Largest number of views to measure, evenly spaced; default: all."""
    downscales: Annotated[list[Downscale], Field(min_length=1)] | None = None
    """Divisors of the original image size; default: the smallest divisor used in training."""
    metrics: list[Metric] = Field(["psnr", "ssim"])
    """Metrics in addition to LPIPS; psnr and ssim are required."""
    lpips: InputPath | None = None
    """ONNX file of LPIPS, which `clsplat data lpips` writes."""
    lpips_input: InputRange = "-1..1"
    """Range of the input of LPIPS; the tables of 3DGS and Mip-Splatting use 0..1 and the network vgg."""
    file: Annotated[str, AfterValidator(_check_output_path)] | None = None
    """Model file in the run folder to measure; default: the model in training."""

    @field_validator("metrics")
    @classmethod
    def _require_psnr_and_ssim(cls, metrics: list[Metric]) -> list[Metric]:
        if not {"psnr", "ssim"} <= set(metrics):
            raise ValueError("'psnr' and 'ssim' are required, since every metrics.json has them; add them")
        return metrics

    def check(self) -> None:
        self._open_metrics()

    def _open_metrics(self) -> Perceptual:
        return Perceptual.open(self.metrics, self.lpips, self.lpips_input)

    def _painter(self, run: Run) -> Painter:
        if self.file is None:
            return run.painter()
        return SplatPainter(
            run.rasterizer,
            load(run.out / self.file).in_scene(run.scene).upload(run.device),
            run.photographs.background,
        )

    def run(self, run: Run) -> None:
        if not run.scene.split(self.split):
            if (
                self.split != "test" or run.pipeline["scene"]["holdout"] != 0
            ):  # no warning if the user wants no test views
                key = "holdout" if self.split == "test" else "validation"
                LOG.warning("there are no %s views to evaluate; select some with scene.%s", self.split, key)
            return
        metrics, painter = self._open_metrics(), self._painter(run)
        for downscale in self.downscales or [run.downscale]:
            candidates = learned_scene(run).downscaled(downscale).split(self.split)
            views = sample_views(candidates, self.max_views or len(candidates))
            photographs = run.photographs if downscale in run.scene.downscales else run.photographs.empty_copy()
            progress = run.status.counted(run.until_interrupted(views), "views", len(views))
            train_views, colors = run.scene.split("train"), color_model(run)
            results = measure(
                painter, views, photographs, metrics, colors=colors, progress=progress, train_views=train_views
            )
            if not results:
                continue
            for result in results:
                run.records.add(run.model_step, "view", split=self.split, downscale=downscale, **result.line())
            averages = mean(results, metrics)
            run.records.add(run.model_step, "evaluate", split=self.split, downscale=downscale, **averages)
            run.metrics.setdefault(self.split, {})[f"{downscale:g}"] = averages
            views_text = f"{f'{self.file}, ' if self.file else ''}{self.split} views at 1/{downscale:g}"
            quality = f"PSNR {averages['psnr']:.2f} dB  SSIM {averages['ssim']:.4f}"
            quality += f"  LPIPS {averages['lpips']:.4f}" if averages["lpips"] is not None else ""
            line = f"step {run.model_step}  {views_text}: {quality}  ({pluralize(len(results), 'view')})"
            if run.cache.get("evaluated") != line:  # the last evaluation of a training may be the same
                run.cache["evaluated"] = line
                LOG.info("%s", line)
            log_color_metrics(averages)
