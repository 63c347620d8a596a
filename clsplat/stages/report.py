"""Write the report of a run, a page that opens offline: renders, cameras, metrics, curves, times, and settings."""

import logging
import os
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from clsplat.core.errors import pluralize, size_text
from clsplat.core.files import PIPELINE, write_text
from clsplat.core.page import data_url, duration_text, mark_charts_safe, render
from clsplat.core.reading import read_text
from clsplat.metrics.perceptual import Image
from clsplat.metrics.views import QUANTILES, render_view
from clsplat.prepare.gather import summarize_placement
from clsplat.scene.scene import SPLITS, format_position
from clsplat.stages.advice import collect_advice
from clsplat.stages.export import sky_gaussians
from clsplat.training.best_model import Scores
from clsplat.training.records import PSNR_REPORTS, moving_average
from clsplat.training.run import Run
from clsplat.training.stage import Stage, path_in_run
from clsplat.viewer.charts import COLORS, Line, camera_plans, line_chart


def draw_cameras(run: Run) -> list[Markup]:
    """Draw the cameras of each split and the Gaussians around them, from above and from the side."""
    points = run.model.gaussians.get("means") if run.gaussians else np.zeros((0, 3), np.float32)
    return mark_charts_safe(camera_plans({split: run.original.split(split) for split in SPLITS}, points))


# Curves over steps, and of the Gaussians.

NAMES = {"train": "training views", "test": "test views", "validation": "validation views"}
DOTTED_DASH = 2  # index into DASHES


def training_charts(run: Run) -> list[Markup]:
    """Draw PSNR, loss, number of Gaussians and time per step over the steps."""
    records = run.records.read("train")
    psnr_lines, trial_lines = _psnr_lines(run), _psnr_lines(run, trial=True)
    dash = DOTTED_DASH if any(line.name == NAMES["train"] for line in psnr_lines) else 0
    psnr = list(zip([r["step"] for r in records], moving_average([r["psnr"] for r in records]), strict=True))
    series = {key: [(r["step"], r[key]) for r in records if key in r] for key in ("loss", "gaussians", "ms")}
    running_mean = Line(psnr, f"training views, mean of the last {PSNR_REPORTS}", COLORS[0], dash)
    return mark_charts_safe(
        [
            line_chart("PSNR, dB", [running_mean, *psnr_lines]),
            *([line_chart("PSNR before the refit, dB", trial_lines)] if trial_lines else []),
            line_chart("loss", [Line(series["loss"])], logarithmic=True),
            line_chart("Gaussians", [Line(series["gaussians"])]),
            line_chart("milliseconds per step", [Line(series["ms"])]),
        ]
        if records
        else []
    )


def _psnr_lines(run: Run, trial: bool = False) -> list[Line]:
    """Return the measured PSNR of each split over the steps; the last measurement of a step counts.

    trial: whether to return the PSNR of the training before a refit.
    """
    psnr_by_split: dict[str, dict[int, float]] = {split: {} for split in NAMES}
    for line in run.records.read("evaluate", trial):
        if line["downscale"] == run.downscale and line["split"] in psnr_by_split:
            psnr_by_split[line["split"]][line["step"]] = line["psnr"]
    colors = dict(zip(NAMES, COLORS, strict=False))
    return [Line(sorted(psnr.items()), NAMES[split], colors[split]) for split, psnr in psnr_by_split.items() if psnr]


def gaussians_charts(run: Run) -> list[Markup]:
    """Draw distributions of size, shape and opacity, and effects of the density rules."""
    lines = run.records.read("distribution")
    if len(lines) < 2:
        return []
    labels = [f"{q:.0%}" for q in QUANTILES]

    def quantiles(name: str) -> list[Line]:
        return [Line([(r["step"], r[name][i]) for r in lines], label) for i, label in enumerate(labels)]

    return mark_charts_safe(
        [
            line_chart("size (rms scale, scene units), quantiles", quantiles("size"), logarithmic=True),
            line_chart("anisotropy (longest / shortest axis), quantiles", quantiles("anisotropy"), logarithmic=True),
            line_chart("opacity, quantiles", quantiles("opacity")),
            line_chart("Gaussians changed by each rule, total", _totals(run)),
        ]
    )


def _totals(run: Run) -> list[Line]:
    """Return the total number of Gaussians that each density rule has changed, over the steps."""
    edits = run.records.read("densify")
    names = dict.fromkeys(name for edit in edits for name in edit["causes"])
    totals = {name: np.cumsum([edit["causes"].get(name, 0) for edit in edits]) for name in names}
    steps = [edit["step"] for edit in edits]
    return [Line(list(zip(steps, map(float, total), strict=True)), name) for name, total in totals.items()]


# Overfitting.

REMEDY = (
    "More photos, taken between the existing ones, help most; `scene.validation: auto` with `optimize.keep: best`, in "
    "a pipeline without `average`, such as splat_7k, keeps the model that is best at views it was not trained on."
)


def overfitting_note(run: Run) -> str:
    """Return sentences that compare the PSNR of training views with that of held-out views.

    Returns "" if the PSNR of either is unknown, or if only test views were measured and the model does not overfit.
    """
    if run.best:
        return run.best.text()
    split, scores = _held_out_scores(run)
    if scores is None:
        return ""
    text = scores.text(split)
    return f"{text} {REMEDY}" if scores.is_overfit else text if split == "validation" else ""


def is_overfit(run: Run) -> bool:
    """Return whether the model is known to be overfit."""
    scores = run.best.measured if run.best else _held_out_scores(run)[1]
    return scores is not None and scores.is_overfit


def _held_out_scores(run: Run) -> tuple[str, Scores | None]:
    """Return the name of the held-out split, its last PSNR, and the last PSNR of the training views.

    The split is validation if it was measured, otherwise test.  If the training views were not measured, their PSNR is
    from the training log.
    """
    lines = [line for line in run.records.read("evaluate") if line["downscale"] == run.downscale]
    for split in ("validation", "test"):
        held_out_lines = [line for line in lines if line["split"] == split]
        train = _training_psnr(run, lines, held_out_lines[-1]["step"]) if held_out_lines else None
        if train is not None:
            return split, Scores(step=held_out_lines[-1]["step"], train=train, validation=held_out_lines[-1]["psnr"])
    return "", None


def _training_psnr(run: Run, lines: list[dict[str, Any]], step: int) -> float | None:
    """Return the PSNR of training views in dB: as measured at a step, or else averaged from the log before it."""
    values = [line["psnr"] for line in lines if line["split"] == "train" and line["step"] == step]
    reports = [line["psnr"] for line in run.records.read("train") if line["step"] <= step]
    return values[-1] if values else moving_average(reports)[-1] if reports else None


# The time of a training step on the device.


@dataclass(frozen=True)
class StageTime:
    """The mean time of a stage of a training step."""

    name: str
    milliseconds: float
    percent: float


@dataclass(frozen=True)
class Times:
    """The device times of a step's stages, averaged over the sampled steps."""

    samples: int
    milliseconds: float  # of all stages
    stages: list[StageTime]


def stage_times(run: Run) -> Times | None:
    """Return the mean time of each stage of a step, or None if no step was sampled."""
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    total = sum(totals.values())
    if total == 0:
        return None
    return Times(len(samples), total, [StageTime(name, ms, 100 * ms / total) for name, ms in totals.items()])


# The best and the worst views, next to their photos.

MAX_VIEWS = 3  # of each


@dataclass(frozen=True)
class ViewFigure:
    """Images of a view with a caption."""

    caption: str
    images: dict[str, str]  # label -> data URL


def view_figures(run: Run) -> dict[str, list[ViewFigure]]:
    """Return images of the best and the worst views of the last evaluation, keyed by heading."""
    by_name = {view.name: view for view in run.scene.downscaled(run.downscale).views}
    lines = [r for r in run.records.read("view") if r["downscale"] == run.downscale and r["step"] == run.model_step]
    latest = {r["view"]: r for r in lines if r["view"] in by_name}  # a view may be measured twice at the same step
    ranking = sorted(latest.values(), key=lambda r: r["psnr"])
    worst = ranking[:MAX_VIEWS]
    best = [r for r in reversed(ranking) if r not in worst][:MAX_VIEWS]
    groups = {"The best views": best, "The worst views": worst}

    def view_figure(record: dict[str, Any]) -> ViewFigure:
        photograph = run.photographs.get(by_name[record["view"]])
        image = render_view(run.painter(), photograph.camera)
        return _figure(record, image, photograph.image())

    return {
        title: [view_figure(record) for record in run.until_interrupted(records)]
        for title, records in groups.items()
        if records
    }


def _figure(record: dict[str, Any], image: Image, photograph: Image) -> ViewFigure:
    difference = np.clip(np.abs(image.astype(np.int16) - photograph) * 4, 0, 255).astype(np.uint8)
    images = {"render": image, "photo": photograph, "difference": difference}
    caption = f"{record['view']} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return ViewFigure(caption, {label: data_url(pixels) for label, pixels in images.items()})


LOG = logging.getLogger("clsplat")
MORE_METRICS = {  # of clsplat/metrics/views.py: name and unit
    "psnr_color": ("PSNR in the photos' colors", "dB"),
    "psnr_affine": ("PSNR with colors fitted", "dB"),
    "psnr_held_out_moments": ("PSNR at held-out timestamps", "dB"),
    "psnr_other_moments": ("PSNR at other timestamps", "dB"),
    "psnr_static": ("PSNR of static pixels", "dB"),
    "flicker": ("flicker of static pixels", "levels"),
    "flicker_photographs": ("flicker of static pixels in the photos", "levels"),
}


class HtmlReport(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"painter", "metrics"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(".html")] = "report.html"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        sentences = collect_advice(run, is_overfit(run))
        page = render(
            "report.html.j2",
            title=run.scene_name,
            subtitle=f"{run.name} · {run.device.label}",
            main=_headline(run),
            overfitting_note=overfitting_note(run),
            advice=sentences,
            photographs=summarize_placement(run.preparation) or f"{pluralize(len(run.original.views), 'photo')}",
            viewers=_relative_urls(run, "viewer", run.out / self.file),
            models=_relative_urls(run, "export", run.out / self.file),
            views=view_figures(run),
            cameras=draw_cameras(run),
            figures=_summary_values(run),
            training=training_charts(run),
            gaussians=gaussians_charts(run),
            times=stage_times(run),
            settings=_read_pipeline(run),
        )
        write_text(run.out / self.file, page)
        LOG.debug("report written to %s", run.out / self.file)  # the summary of the run names its files
        for text in sentences:
            LOG.info("advice: %s", text)


def _relative_urls(run: Run, stage: str, page: Path) -> dict[str, str]:
    """Return the relative URLs of the files that stages named `stage` write, by path in the run folder."""
    files = [Path(entry[stage]["file"]) for entry in run.pipeline["stages"] if stage in entry]
    return {file.as_posix(): quote(Path(os.path.relpath(run.out / file, page.parent)).as_posix()) for file in files}


def _headline(run: Run) -> str:
    """Return the most important results as a line of text."""
    test = run.metrics.get("test", {}).get(f"{run.downscale:g}")
    quality = [f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}"] if test else []
    quality += [f"the model of step {run.model_step:,}"] if run.model_step != run.step else []
    facts = _model_size(run), f"trained for {duration_text(run.train_seconds)}"
    return " · ".join([*quality, *facts])


def _model_size(run: Run) -> str:
    return size_text(
        run.gaussians, run.learned_field.parameter_count if run.learned_field else None, sky_gaussians(run)
    )


def _summary_values(run: Run) -> dict[str, str]:
    values = {}
    for split, by_downscale in sorted(run.metrics.items(), key=lambda item: SPLITS.index(item[0])):
        for downscale, averages in by_downscale.items():
            suffix = "" if downscale == f"{run.downscale:g}" else f" at 1/{downscale}"
            values[f"{split} PSNR{suffix} ({pluralize(averages['views'], 'view')})"] = f"{averages['psnr']:.2f} dB"
            for key, (name, unit) in MORE_METRICS.items():
                if averages.get(key) is not None:
                    views = f" ({pluralize(averages[f'{key}_views'], 'view')})" if f"{key}_views" in averages else ""
                    values[f"{split} {name}{suffix}{views}"] = f"{averages[key]:.2f} {unit}"
            values[f"{split} SSIM{suffix}"] = f"{averages['ssim']:.4f}"
            if averages.get("lpips") is not None:
                values[f"{split} LPIPS{suffix}"] = f"{averages['lpips']:.4f}"
    if run.is_refit and run.best:
        best_scores = run.best.measured
        values["validation PSNR before the refit"] = f"{best_scores.validation:.2f} dB"
        values["training PSNR before the refit"] = f"{best_scores.train:.2f} dB"
    text, _, sky = _model_size(run).partition(" and ")
    number, _, unit = text.partition(" ")
    values[unit] = number + (f" and {sky}" if sky else "")
    values["steps"] = f"{run.step:,}"
    values["training"] = duration_text(run.train_seconds)
    if run.scene.origin.any():
        values["origin of the coordinates"] = format_position(run.scene.origin)
    return values


def _read_pipeline(run: Run) -> str:
    path = run.out / PIPELINE
    return read_text(path) if path.exists() else ""
