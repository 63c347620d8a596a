"""The run as one page that opens offline: figures, curves, times on the device, views beside photographs, settings."""

import logging
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.metrics.distribution import SHARES
from clsplat.metrics.perceptual import Image
from clsplat.metrics.views import render_view
from clsplat.names import PIPELINE
from clsplat.pages.page import charts, counted, duration, embedded, render
from clsplat.pages.svg import Line, curve
from clsplat.reading import read_file, read_text
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
MAX_VIEWS = 3  # of the worst, and of the best


class Report(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "metrics"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(".html")] = "report.html"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        page = render(
            "report.html.j2",
            title=f"{run.name} · {run.scene.path.name}",
            subtitle=run.device.text,
            viewers=_viewers(run, run.out / self.file),
            figures=_figures(run),
            training=_training_charts(run),
            gaussians=_gaussians_charts(run),
            times=_times(run),
            views=_views(run),
            settings=_settings(run),
        )
        write_text(run.out / self.file, page)
        LOG.info("report written to %s", run.out / self.file)

    def verify(self, run: Run) -> None:
        if not read_file(run.out / self.file).rstrip().endswith(b"</html>"):
            raise DataError(f"{run.out / self.file}: ends before its end")


@dataclass(frozen=True)
class StageTime:
    """The mean time of one stage of a training step."""

    name: str
    milliseconds: float
    percent: float


@dataclass(frozen=True)
class Times:
    """The time of a step's stages on the device, averaged over the sampled steps."""

    samples: int
    milliseconds: float  # of all stages
    stages: list[StageTime]


@dataclass(frozen=True)
class ViewFigure:
    """Images of one view with a caption."""

    caption: str
    images: dict[str, str]  # label -> data URL


def _viewers(run: Run, page: Path) -> list[str]:
    """The pages of the pipeline that show the model, as addresses beside this one."""
    files = [run.out / stage["viewer"]["file"] for stage in run.pipeline["stages"] if "viewer" in stage]
    return [quote(Path(os.path.relpath(file, page.parent)).as_posix()) for file in files]


def _figures(run: Run) -> dict[str, str]:
    values = {}
    for split, by_downscale in run.metrics.items():
        for downscale, averages in by_downscale.items():
            suffix = "" if downscale == f"{run.downscale:g}" else f" at 1/{downscale}"
            values[f"{split} PSNR{suffix} ({counted(averages['views'], 'view')})"] = f"{averages['psnr']:.2f} dB"
            values[f"{split} SSIM{suffix}"] = f"{averages['ssim']:.4f}"
    values["Gaussians"] = f"{run.model.gaussians.count:,}"
    values["steps"] = f"{run.step:,}"
    values["training"] = duration(run.train_seconds)
    return values


def _training_charts(run: Run) -> list[Markup]:
    train, tests = run.records.read("train"), run.records.read("evaluate")
    line = {key: [(r["step"], r[key]) for r in train] for key in ("loss", "psnr", "gaussians", "ms")}
    measured = [
        Line(
            [(r["step"], r["psnr"]) for r in tests if r["split"] == split and r["downscale"] == run.downscale],
            f"{split} views",
        )
        for split in ("test", "train")
    ]
    return charts(
        [
            curve("PSNR, dB", [Line(line["psnr"], "single training views"), *measured]),
            curve("loss", [Line(line["loss"])], logarithmic=True),
            curve("Gaussians", [Line(line["gaussians"])]),
            curve("milliseconds per step", [Line(line["ms"])]),
        ]
        if train
        else []
    )


def _gaussians_charts(run: Run) -> list[Markup]:
    """Distributions of size, shape and opacity during training, effects of the density rules, PSNR by Gaussians."""
    lines = run.records.read("distribution")
    if len(lines) < 2:
        return []
    shares = [f"{share:.0%}" for share in SHARES]

    def quantiles(name: str) -> list[Line]:
        return [Line([(r["step"], r[name][i]) for r in lines], share) for i, share in enumerate(shares)]

    return charts(
        [
            curve("size (rms scale, scene units), quantiles", quantiles("size"), logarithmic=True),
            curve("anisotropy (longest by shortest axis), quantiles", quantiles("anisotropy"), logarithmic=True),
            curve("opacity, quantiles", quantiles("opacity")),
            curve("Gaussians changed by each rule, in all", _totals(run, "causes")),
            curve("share of growth so far, by rule", _shares(_totals(run, "grown"))),
            curve("test PSNR, dB, over thousands of Gaussians", _psnr_by_gaussians(run)),
        ]
    )


def _totals(run: Run, what: str) -> list[Line]:
    """Gaussians that each rule of density control has changed so far, or added."""
    edits = run.records.read("densify")
    names = dict.fromkeys(name for edit in edits for name in edit.get(what, {}))
    totals = {name: np.cumsum([edit.get(what, {}).get(name, 0) for edit in edits]) for name in names}
    steps = [edit["step"] for edit in edits]
    return [Line(list(zip(steps, map(float, total), strict=True)), name) for name, total in totals.items()]


def _shares(lines: Sequence[Line]) -> list[Line]:
    """The lines divided by their sum, where it is not zero; lines that are always zero are left out."""
    sums = np.sum([[y for _, y in line.points] for line in lines], axis=0) if lines else []
    shares = [[(x, y / total) for (x, y), total in zip(line.points, sums, strict=True) if total > 0] for line in lines]
    return [Line(points, line.name) for points, line in zip(shares, lines, strict=True) if any(y for _, y in points)]


def _psnr_by_gaussians(run: Run) -> list[Line]:
    """Points in order of steps: where Gaussians are pruned, the line turns back.  No line for a single point."""
    counts = {r["step"]: r["gaussians"] for r in run.records.read("train")}
    tests = [r for r in run.records.read("evaluate") if r["split"] == "test" and r["downscale"] == run.downscale]
    points = {r["step"]: (counts[r["step"]] / 1e3, r["psnr"]) for r in tests if r["step"] in counts}
    return [Line(list(points.values()))] if len(points) > 1 else []


def _times(run: Run) -> Times | None:
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    whole = sum(totals.values())
    if whole == 0:
        return None
    return Times(len(samples), whole, [StageTime(name, ms, 100 * ms / whole) for name, ms in totals.items()])


def _views(run: Run) -> dict[str, list[ViewFigure]]:
    """The worst and the best views of the last evaluation, by heading."""
    by_name = {view.name: view for view in run.scene.downscaled(run.downscale).views}
    lines = [r for r in run.records.read("view") if r["downscale"] == run.downscale and r["step"] == run.step]
    last = {r["view"]: r for r in lines if r["view"] in by_name}  # a view may be measured twice after the same step
    ranked = sorted(last.values(), key=lambda r: r["psnr"])
    worst = ranked[:MAX_VIEWS]
    best = [r for r in reversed(ranked) if r not in worst][:MAX_VIEWS]
    chosen = {"Worst": worst, "Best": best}

    def figure(record: dict[str, Any]) -> ViewFigure:
        photograph = run.photographs.get(by_name[record["view"]])
        image = render_view(run.rasterizer, run.model, photograph.camera, run.photographs.background)
        return _figure(record, image, photograph.image())

    return {
        title: [figure(record) for record in run.until_interrupted(records)]
        for title, records in chosen.items()
        if records
    }


def _figure(record: dict[str, Any], image: Image, photograph: Image) -> ViewFigure:
    difference = np.clip(np.abs(image.astype(np.int16) - photograph) * 4, 0, 255).astype(np.uint8)
    images = {"render": image, "photograph": photograph, "difference": difference}
    caption = f"{record['view']} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return ViewFigure(caption, {label: embedded(pixels) for label, pixels in images.items()})


def _settings(run: Run) -> str:
    path = run.out / PIPELINE
    return read_text(path) if path.exists() else ""
