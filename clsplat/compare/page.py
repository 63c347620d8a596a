"""Runs side by side, as one page that opens offline: metrics, curves, scales, crops, differing settings."""

import html
import logging
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from clsplat.compare import crops, tables
from clsplat.compare.comparison import Comparison, Row
from clsplat.errors import ConfigError, DataError
from clsplat.files import write_text
from clsplat.pages.page import page
from clsplat.pages.svg import Line, curve

LOG = logging.getLogger("clsplat")


def write_comparison(paths: Sequence[Path], out: Path, title: str = "", remarks: Sequence[str] = ()) -> int:
    """Write the page on some run folders; return the number of runs on it.  Raises what Comparison.read raises."""
    comparison = Comparison.read(paths)
    write_text(out, comparison_page(comparison, title, remarks))
    return len(comparison.runs)


def comparison_page(comparison: Comparison, title: str, remarks: Sequence[str]) -> str:
    """Return the page; its title is by default the names of the pipelines, and `remarks` stand at its top."""
    sections = [f"<p class=note>{html.escape(remark)}</p>" for remark in remarks]
    if len(comparison.scenes) > 1:
        sections.append(tables.over_scenes(comparison))
    for scene, rows in comparison.scenes.items():
        sections += [f"<h2>{html.escape(scene)}</h2>", tables.metrics(rows), _curves(rows), _crops(rows)]
    sections += [tables.settings(comparison.variants), tables.folders(comparison)]
    names = list(dict.fromkeys(run.metrics.pipeline for run in comparison.runs))
    title = title or f"{' · '.join(names[:4])}{' · …' if len(names) > 4 else ''}"
    title += f": {_counted(len(comparison.runs), 'run')}"
    subtitle = f"{_counted(len(comparison.variants), 'variant')} on {_counted(len(comparison.scenes), 'scene')}"
    devices = {run.metrics.device for run in comparison.runs}
    subtitle += f"; device: {devices.pop()}" if len(devices) == 1 else "; several devices"
    return page(title, subtitle, sections, tables.STYLE + crops.STYLE, crops.SCRIPT)


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'s' if count != 1 else ''}"


def _curves(rows: Sequence[Row]) -> str:
    """PSNR and Gaussians over steps, a line for each run; then quality over image sizes."""

    def lines(kind: str, figure: str, **where: object) -> list[Line]:
        found = [(row.variant.colour, run.points(kind, figure, **where)) for row in rows for run in row.runs]
        return [Line(points, colour=colour) for colour, points in found if len(points) > 1]

    charts = [
        curve(
            "test PSNR over steps, dB", lines("evaluate", "psnr", split="test", scale=rows[0].runs[0].scene.downscale)
        ),
        curve("PSNR of single training views over steps, dB", lines("train", "psnr")),
        curve("Gaussians over steps", lines("train", "gaussians")),
        *(chart for split in ("test", "train") for chart in _scale_charts(rows, split)),
    ]
    if not any(charts):
        return "<p class=note>no curves: the runs have no metrics.jsonl</p>"
    legend = " &ensp; ".join(tables.label(row.variant) for row in rows)
    return f"<h3>Curves</h3><p class=sub>{legend}</p><div class=curves>{''.join(charts)}</div>"


def _scale_charts(rows: Sequence[Row], split: str) -> list[str]:
    scales = tables.scales(rows, split)
    if len(scales) < 2:
        return []
    ticks = {float(i): "full size" if scale == "1" else f"1/{scale}" for i, scale in enumerate(scales)}
    charts = []
    for metric, title in (("psnr", f"{split} PSNR by image size, dB"), ("ssim", f"{split} SSIM by image size")):
        lines = []
        for row in rows:
            means = [(float(i), row.figures(split, scale, metric)) for i, scale in enumerate(scales)]
            lines.append(Line([(i, fmean(values)) for i, values in means if values], colour=row.variant.colour))
        charts.append(curve(title, lines, ticks=ticks))
    return charts


def _crops(rows: Sequence[Row]) -> str:
    """Crops of each row's first run; a scene that has moved away since leaves a remark."""
    cases = [crops.Case(tables.label(row.variant), row.runs[0]) for row in rows]
    try:
        settings = rows[0].runs[0].scene
        photographs, background = settings.read(rows[0].runs[0].photographs)
        scene = photographs.downscaled(settings.downscale)
    except (DataError, ConfigError) as error:
        LOG.warning("no crops: %s", error)
        return f"<p class=note>no crops: {html.escape(str(error))}</p>"
    shown = crops.crops(cases, scene, background)
    if not shown:
        return "<p class=note>no crops: no view that all runs rendered; `- render` among the stages does it</p>"
    place = "the runs differ most" if len(rows) > 1 else "the run differs most from the photograph"
    return (
        f"<h3>Where {place}</h3><p class=sub>Drag across a picture: left of the line is the render, right of it the "
        f"photograph.  Of several seeds the first is shown.</p>{shown}"
    )
