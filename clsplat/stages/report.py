"""The run as one page that opens offline: figures, curves, where the time goes, views beside the truth, settings."""

import html
import logging
from collections import defaultdict
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.files import write_text
from clsplat.metrics.distribution import SHARES
from clsplat.metrics.perceptual import Image
from clsplat.metrics.views import render_view
from clsplat.pages.page import duration, embedded, figures, page
from clsplat.pages.svg import Line, curve
from clsplat.stages.base import Stage
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
SHOWN = 3  # worst and best views


class Report(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "metrics"})

    file: str = "report.html"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        sections = [_figures(run), _curves(run), _census(run), _times(run), _views(run), _settings(run)]
        title = f"{run.name} · {run.scene.path.name}"
        write_text(run.out / self.file, page(title, run.device.text, sections))
        LOG.info("report written to %s", run.out / self.file)


def _figures(run: Run) -> str:
    values = {}
    for split, scales in run.metrics.items():
        for scale, averages in scales.items():
            suffix = "" if scale == f"{run.scale:g}" else f" at 1/{scale}"
            values[f"{split} PSNR{suffix} ({averages['views']} views)"] = f"{averages['psnr']:.2f} dB"
            values[f"{split} SSIM{suffix}"] = f"{averages['ssim']:.4f}"
    values["Gaussians"] = f"{run.model.gaussians.count:,}"
    values["steps"] = f"{run.step:,}"
    values["training"] = duration(run.train_seconds)
    return figures(values)


def _curves(run: Run) -> str:
    train, tests = run.records.read("train"), run.records.read("evaluate")
    if not train:
        return ""
    line = {key: [(r["step"], r[key]) for r in train] for key in ("loss", "psnr", "gaussians", "ms")}
    measured = [
        Line(
            [(r["step"], r["psnr"]) for r in tests if r["split"] == split and r["scale"] == run.scale], f"{split} views"
        )
        for split in ("test", "train")
    ]
    charts = [
        curve("PSNR, dB", [Line(line["psnr"], "view trained on"), *measured]),
        curve("loss", [Line(line["loss"])], logarithmic=True),
        curve("Gaussians", [Line(line["gaussians"])]),
        curve("milliseconds per step", [Line(line["ms"])]),
    ]
    return f"<h2>Training</h2><div class=curves>{''.join(charts)}</div>"


def _census(run: Run) -> str:
    """How sizes, shapes and opacities are spread over training, what density rules did, and PSNR by Gaussians."""
    lines = run.records.read("distribution")
    if len(lines) < 2:
        return ""
    shares = [f"{share:.0%}" for share in SHARES]

    def spread(name: str) -> list[Line]:
        return [Line([(r["step"], r[name][i]) for r in lines], share) for i, share in enumerate(shares)]

    charts = [
        curve("size (rms scale, scene units), quantiles", spread("size"), logarithmic=True),
        curve("anisotropy (longest by shortest axis), quantiles", spread("anisotropy"), logarithmic=True),
        curve("opacity, quantiles", spread("opacity")),
        curve("Gaussians changed by each rule, in all", _totals(run, "causes")),
        curve("share of growth so far, by rule", _shares(_totals(run, "grown"))),
        curve("test PSNR, dB, over thousands of Gaussians", [Line(_psnr_by_gaussians(run))]),
    ]
    return f"<h2>The Gaussians</h2><div class=curves>{''.join(charts)}</div>"


def _totals(run: Run, what: str) -> list[Line]:
    """Gaussians that each rule of density control has taken so far, or made grow."""
    edits = run.records.read("densify")
    names = dict.fromkeys(name for edit in edits for name in edit.get(what, {}))
    totals = {name: np.cumsum([edit.get(what, {}).get(name, 0) for edit in edits]) for name in names}
    steps = [edit["step"] for edit in edits]
    return [Line(list(zip(steps, map(float, total), strict=True)), name) for name, total in totals.items()]


def _shares(lines: list[Line]) -> list[Line]:
    """The lines by their sum, from where it is not zero; those that stay at zero are left out."""
    sums = np.sum([[y for _, y in line.points] for line in lines], axis=0) if lines else []
    shares = [[(x, y / total) for (x, y), total in zip(line.points, sums, strict=True) if total > 0] for line in lines]
    return [Line(points, line.name) for points, line in zip(shares, lines, strict=True) if any(y for _, y in points)]


def _psnr_by_gaussians(run: Run) -> list[tuple[float, float]]:
    """In order of steps: where Gaussians are thinned out, the line turns back."""
    counts = {r["step"]: r["gaussians"] for r in run.records.read("train")}
    tests = [r for r in run.records.read("evaluate") if r["split"] == "test" and r["scale"] == run.scale]
    return [(counts[r["step"]] / 1e3, r["psnr"]) for r in tests if r["step"] in counts]


def _times(run: Run) -> str:
    """Where a step's time goes on the device, averaged over the sampled steps."""
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    if not samples:
        return ""
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    whole = sum(totals.values())
    rows = "".join(
        f"<tr><td>{html.escape(name)}<td>{ms:.2f}<td>{100 * ms / whole:.0f} %"
        f"<td class=bar><i style='width:{100 * ms / whole:.1f}%'></i>"
        for name, ms in totals.items()
    )
    return (
        f"<h2>A training step on the device</h2><p class=sub>average of {len(samples)} sampled steps</p>"
        f"<table><tr><th>stage<th>ms<th>share<th>{rows}<tr><td>sum<td>{whole:.2f}<td><td></table>"
    )


def _views(run: Run) -> str:
    """The worst and the best views of the last evaluation: render, truth and four times their difference."""
    by_name = {view.name: view for view in run.scene.downscaled(run.scale).views}
    lines = [r for r in run.records.read("view") if r["scale"] == run.scale and r["step"] == run.step]
    last = {r["view"]: r for r in lines if r["view"] in by_name}  # it may have been measured twice after the same step
    ranked = sorted(last.values(), key=lambda r: r["psnr"])
    if not ranked:
        return ""
    worst = ranked[:SHOWN]
    best = [r for r in reversed(ranked) if r not in worst][:SHOWN]
    text = "<h2>Views</h2><p class=sub>render · photograph · difference, four times amplified</p>"
    for title, chosen in (("Worst", worst), ("Best", best)):
        text += f"<h3>{title}</h3>" if chosen else ""
        for record in chosen:
            target = run.photographs.get(by_name[record["view"]])
            image = render_view(run.rasterizer, run.model, target.camera, run.photographs.background)
            text += _figure(record, image, target.image())
    return text


def _figure(record: dict[str, Any], image: Image, truth: Image) -> str:
    difference = np.clip(np.abs(image.astype(np.int16) - truth) * 4, 0, 255).astype(np.uint8)
    pictures = "".join(f'<img src="{embedded(picture)}" alt="">' for picture in (image, truth, difference))
    name = html.escape(record["view"])
    caption = f"{name} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return f"<figure><div>{pictures}</div><figcaption>{caption}</figcaption></figure>"


def _settings(run: Run) -> str:
    path = run.out / "pipeline.yaml"
    text = path.read_text() if path.exists() else ""
    return f"<h2>Settings</h2><pre>{html.escape(text)}</pre>"
