"""Write runs side by side as a page that opens offline: metrics, curves, crops, differing settings."""

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from clsplat.core.errors import ConfigError, DataError, pluralize
from clsplat.core.files import write_text
from clsplat.core.page import data_url, duration_text, render, safe_charts
from clsplat.pipeline.file import SceneSettings
from clsplat.runs.results import Points, RunFolder, RunMetrics
from clsplat.sweeps.compare.comparison import PublishedTable, RunComparison, Variant, VariantRow, differing
from clsplat.sweeps.compare.crops import ImageCrop, find_crops
from clsplat.training.records import VIEWS, moving_average
from clsplat.viewer.charts import COLORS, Line, curve

# The tables: metrics and costs, means over scenes, differing settings.

METRICS = {  # name -> heading, digits, function that returns the better one
    "psnr": ("PSNR ↑", 2, max),
    "psnr_color": ("PSNR in the photographs' colors ↑", 2, max),
    "psnr_affine": ("PSNR, colors fitted ↑", 2, max),
    "psnr_held_out_moments": ("PSNR, held-out moments ↑", 2, max),
    "psnr_other_moments": ("PSNR, other moments ↑", 2, max),
    "psnr_static": ("PSNR, static pixels ↑", 2, max),
    "flicker": ("flicker of static pixels, levels ↓", 2, min),
    "ssim": ("SSIM ↑", 4, max),
    "ms_ssim": ("MS-SSIM ↑", 4, max),
    "flip": ("FLIP ↓", 4, min),
    "lpips": ("LPIPS ↓", 4, min),
}
CONDITIONS = {"lpips_input": "input range of LPIPS", "lpips_model": "LPIPS network"}
MAX_SEEDS = 3  # that are listed


@dataclass(frozen=True)
class TableCell:
    """A mean as text, with the standard deviation if there are several runs."""

    text: str
    deviation: str = ""
    best: bool = False


@dataclass(frozen=True)
class Column:
    """One value per row."""

    heading: str
    cells: list[TableCell]


@dataclass(frozen=True)
class Group:
    """Columns with a common title."""

    title: str
    columns: list[Column]


@dataclass(frozen=True)
class MetricTable:
    """One row per variant."""

    variants: list[Variant]
    groups: list[Group]
    seeds: list[str] = field(default_factory=list)  # by row; empty: not shown


def main_table(rows: Sequence[VariantRow]) -> MetricTable:
    """Return the test metrics at the training size, and the costs."""
    costs = [
        *_cost(rows, "Gaussians", lambda metrics: metrics.gaussians),
        *_cost(rows, "parameters", lambda metrics: metrics.parameters),
        Column("steps", _cells([[run.metrics.steps for run in row.runs] for row in rows], 0)),
        Column("training", [TableCell(duration_text(_train_seconds(row))) for row in rows]),
        *_cost(rows, "CPU seconds", lambda metrics: metrics.cpu_seconds),
        *_cost(rows, "device memory, MB", lambda metrics: metrics.device_memory and metrics.device_memory / 1e6),
    ]
    return _table(rows, [*_trained_on(rows), Group("", costs)])


def _train_seconds(row: VariantRow) -> float:
    return fmean(run.metrics.train_seconds for run in row.runs)


def _cost(rows: Sequence[VariantRow], heading: str, cost: Callable[[RunMetrics], float | None]) -> list[Column]:
    """Return a column of a cost that not all runs record, or none if no run does."""
    costs = [[cost(run.metrics) for run in row.runs] for row in rows]
    values = [[value for value in row if value is not None] for row in costs]
    return [Column(heading, _cells(values, 0))] if any(values) else []


def other_tables(rows: Sequence[VariantRow]) -> list[MetricTable]:
    """Return the metrics of all other sizes and views, a table per split, so that each fits on the page."""
    by_split: dict[str, list[Group]] = {}
    for split, downscale in _measured(rows):
        if (split, downscale) != ("test", rows[0].downscale):
            by_split.setdefault(split, []).append(_group(rows, split, downscale))
    return [_table(rows, groups) for groups in by_split.values()]


def downscales(rows: Sequence[VariantRow], split: str) -> list[str]:
    """Return the divisors of the image sizes at which any row was measured, from full size down."""
    divisors = {downscale for row in rows for downscale in row.downscales(split)}
    return sorted(divisors, key=lambda text: (float(text), text))


def means_over_scenes(comparison: RunComparison) -> MetricTable | None:
    """Return means over the scenes of variants that ran on all of them, or None if no metric has any."""
    scenes = list(comparison.scenes.values())
    everywhere = [[row for rows in scenes for row in rows if row.variant is v] for v in comparison.variants]
    complete = [rows for rows in everywhere if len(rows) == len(scenes)]
    columns = []
    for name, (heading, digits, best) in METRICS.items():
        means = [
            [fmean(values) for row in rows if (values := row.figures("test", row.downscale, name))] for rows in complete
        ]
        if means and all(len(values) == len(scenes) for values in means):
            columns.append(Column(heading, _cells([[fmean(values)] for values in means], digits, best)))
    return MetricTable([rows[0].variant for rows in complete], [Group("", columns)]) if columns else None


def differing_settings(variants: Sequence[Variant]) -> dict[str, list[str]]:
    """Return the settings that differ between variants: key path -> values by variant."""
    key_paths = differing([variant.settings for variant in variants])
    return {key_path: [variant.settings.get(key_path, "–") for variant in variants] for key_path in key_paths}


def differing_conditions(rows: Sequence[VariantRow]) -> Iterable[str]:
    """Yield sentences about conditions that differ between runs, which makes the values of a column incomparable."""
    splits = [split for row in rows for run in row.runs for split in (run.metrics.test, run.metrics.train)]
    averages = [average for split in splits for average in split.values()]
    for key, name in CONDITIONS.items():
        values = {str(value) for average in averages if (value := getattr(average, key, None)) is not None}
        if len(values) > 1:
            yield f"The {name} differs between runs ({', '.join(sorted(values))})."
    for split, downscale in _measured(rows):
        measured = [getattr(run.metrics, split).get(downscale) for row in rows for run in row.runs]
        counts = {mean.color_views for mean in measured if mean is not None and mean.figure("psnr_color") is not None}
        if len(counts) > 1:
            name = f"number of {_title(rows, split, downscale)} with a PSNR in the photographs' colors"
            yield f"The {name} differs between runs ({', '.join(map(str, sorted(counts)))})."


def _measured(rows: Sequence[VariantRow]) -> list[tuple[str, str]]:
    """Return the splits and size divisors at which any row was measured."""
    return [(split, downscale) for split in ("test", "train") for downscale in downscales(rows, split)]


def _trained_on(rows: Sequence[VariantRow]) -> list[Group]:
    """Return the test metrics at the training size, if they were measured."""
    downscale = rows[0].downscale
    return [_group(rows, "test", downscale)] if downscale in downscales(rows, "test") else []


def _group(rows: Sequence[VariantRow], split: str, downscale: str) -> Group:
    columns = [
        Column(heading, _cells([row.figures(split, downscale, name) for row in rows], digits, best))
        for name, (heading, digits, best) in METRICS.items()
        if any(row.figures(split, downscale, name) for row in rows)
    ]
    return Group(_title(rows, split, downscale), columns)


def _title(rows: Sequence[VariantRow], split: str, downscale: str) -> str:
    size = "full size" if downscale == "1" else f"1/{downscale}"
    return f"{split} views" + ("" if downscale == rows[0].downscale == "1" else f" at {size}")


def _table(rows: Sequence[VariantRow], groups: list[Group]) -> MetricTable:
    return MetricTable([row.variant for row in rows], groups, [_seeds(row) for row in rows])


def _seeds(row: VariantRow) -> str:
    seeds = [str(run.metrics.seed) for run in row.runs]
    return ", ".join(seeds) if len(seeds) <= MAX_SEEDS else f"{len(seeds)} seeds"


def _cells(values: Sequence[list[float]], digits: int, best: Callable[..., float] | None = None) -> list[TableCell]:
    """Return a cell per list of values; marks the best of the means, as rounded for display."""
    means = [round(fmean(row), digits) if row else None for row in values]
    present = [mean for mean in means if mean is not None]
    top = best(present) if best and len(present) > 1 else None
    return [_cell(row, mean, digits, mean == top) for row, mean in zip(values, means, strict=True)]


def _cell(values: list[float], mean: float | None, digits: int, best: bool) -> TableCell:
    if mean is None:
        return TableCell("–")
    deviation = stdev(values) if len(values) > 1 else 0.0
    return TableCell(f"{mean:,.{digits}f}", f"{deviation:,.{digits}f}" if deviation > 0 else "", best)


# The charts: quality and Gaussians over steps and CPU seconds, and quality over image sizes.

MAX_LINES = len(COLORS)  # with more runs, a line per variant


def curves(rows: Sequence[VariantRow]) -> list[Markup]:
    """Draw PSNR and Gaussians over steps, a line per run, or per variant if there are many runs; then over sizes."""
    downscale = rows[0].runs[0].scene.downscale
    are_many = sum(len(row.runs) for row in rows) > MAX_LINES
    means = " (means)" if are_many and any(len(row.runs) > 1 for row in rows) else ""

    def lines(points_of: Callable[[RunFolder], Points]) -> list[Line]:
        if are_many:
            of_rows = [_mean([points_of(run) for run in row.runs]) for row in rows]
            return [
                Line(points, row.variant.letter, row.variant.color, i // len(COLORS))
                for i, (row, points) in enumerate(zip(rows, of_rows, strict=True))
                if len(dict(points)) > 1
            ]
        return [
            Line(points, name, row.variant.color, i)
            for row in rows
            for i, (run, name) in enumerate(zip(row.runs, _names(row), strict=True))
            if len(dict(points := points_of(run))) > 1  # a single step is no line
        ]

    def tested(run: RunFolder) -> Points:
        return run.points("evaluate", "psnr", split="test", downscale=downscale)

    def trained(run: RunFolder) -> Points:
        points = run.points("train", "psnr")
        return list(zip([step for step, _ in points], moving_average([psnr for _, psnr in points]), strict=True))

    drawings = [
        curve(f"test PSNR over steps, dB{means}", lines(tested)),
        curve(f"test PSNR over CPU seconds of training, dB{means}", lines(lambda run: run.by_cpu_seconds(tested(run)))),
        curve(f"training PSNR over steps, mean of {VIEWS} views, dB{means}", lines(trained)),
        curve(f"Gaussians over steps{means}", lines(lambda run: run.points("train", "gaussians"))),
    ]
    return safe_charts(drawings + _size_charts(rows, "test") + _size_charts(rows, "train"))


def _mean(lines: Sequence[Points]) -> Points:
    """Return the mean of lines, point by point, up to the end of the shortest."""
    return [(fmean(x for x, _ in points), fmean(y for _, y in points)) for points in zip(*lines, strict=False)]


def _names(row: VariantRow) -> list[str]:
    """Return names for the lines of a row with several runs: their seeds, or their folders if seeds repeat."""
    runs = row.runs
    if len(runs) == 1:
        return [""]
    choices = (
        [f"seed {run.metrics.seed}" for run in runs],
        [run.path.resolve().name for run in runs],
        [str(run.path) for run in runs],
    )
    names = next((names for names in choices if len(set(names)) == len(runs)), choices[-1])
    return [f"{row.variant.letter} {name}" for name in names]


def _size_charts(rows: Sequence[VariantRow], split: str) -> list[str]:
    """Draw PSNR and SSIM over image sizes, a line per variant."""
    sizes = downscales(rows, split)
    if len(sizes) < 2:
        return []
    ticks = {float(i): "full size" if size == "1" else f"1/{size}" for i, size in enumerate(sizes)}
    drawings = []
    for metric, title in (("psnr", f"{split} PSNR by image size, dB"), ("ssim", f"{split} SSIM by image size")):
        lines = []
        for row in rows:
            points = [(float(i), row.figures(split, size, metric)) for i, size in enumerate(sizes)]
            lines.append(Line([(i, fmean(values)) for i, values in points if values], color=row.variant.color))
        drawings.append(curve(title, lines, ticks=ticks))
    return drawings


LOG = logging.getLogger("clsplat")
MAX_NAMES = 4  # of pipelines, in the title


def write_comparison(
    paths: Sequence[Path],
    out: Path,
    title: str = "",
    remarks: Sequence[str] = (),
    published: Sequence[PublishedTable] = (),
) -> int:
    """Write the page for run folders and return the number of runs.  Raises what `RunComparison.read` raises."""
    comparison = RunComparison.read(paths)
    faults = [fault for run in comparison.runs for fault in run.missing_plugins]
    for fault in faults:
        LOG.warning("%s", fault)
    write_text(out, comparison_page(comparison, title, [*remarks, *faults], out.parent, published))
    return len(comparison.runs)


def comparison_page(
    comparison: RunComparison,
    title: str,
    remarks: Sequence[str],
    folder: Path,
    published: Sequence[PublishedTable] = (),
) -> str:
    """Return the page, with links relative to `folder` and `remarks` at the top.

    title: by default the names of the pipelines.
    """
    runs, scenes, variants = comparison.runs, comparison.scenes, comparison.variants
    names = list(dict.fromkeys(run.metrics.pipeline for run in runs))
    title = title or " · ".join([*names[:MAX_NAMES], *(["…"] if len(names) > MAX_NAMES else [])])
    devices = {run.metrics.device for run in runs}
    device = f"device: {devices.pop()}" if len(devices) == 1 else "several devices"
    return render(
        "compare.html.j2",
        title=f"{title}: {pluralize(len(runs), 'run')}",
        subtitle=f"{pluralize(len(variants), 'variant')} on {pluralize(len(scenes), 'scene')}; {device}",
        remarks=remarks,
        means=means_over_scenes(comparison) if len(scenes) > 1 else None,
        scenes=[_section(name, rows) for name, rows in scenes.items()],
        variants=variants,
        published=published,
        settings=differing_settings(variants),
        runs=[(comparison.variant(run), str(run.path), run.metrics.seed, _links(run, folder)) for run in runs],
    )


def _links(run: RunFolder, folder: Path) -> dict[str, str]:
    """Return the addresses of a run's pages, relative to a folder."""
    files = {stage: run.path / run.metrics.files.get(stage, "") for stage in ("report", "viewer")}
    return {
        stage: quote(Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix())
        for stage, file in files.items()
        if file.is_file()
    }


def _section(name: str, rows: Sequence[VariantRow]) -> dict[str, Any]:
    """Return the values of the page's section about a scene."""
    crops, no_crops = _crops(rows)
    several_seeds = any(len(row.runs) > 1 for row in rows)
    explanations = ["mean ± standard deviation over seeds"] if several_seeds else []
    return dict(
        name=name,
        variants=[row.variant for row in rows],
        several_seeds=several_seeds,
        explanations=[*_sizes(rows[0].runs[0].scene), *explanations, *(["bold: the best"] if len(rows) > 1 else [])],
        remarks=list(differing_conditions(rows)),
        main=main_table(rows),
        others=other_tables(rows),
        curves=curves(rows),
        crops=[_figure(crop) for crop in crops],
        no_crops=no_crops,
    )


def _sizes(scene: SceneSettings) -> list[str]:
    """Explain image sizes if the training used others than full size, or several."""
    first, *more = (f"1/{downscale:g}" if downscale != 1 else "full size" for downscale in scene.downscales)
    if first == "full size" and not more:
        return []
    return [f"sizes are relative to the original photographs; trained at {', '.join([first, *more])}"]


def _crops(rows: Sequence[VariantRow]) -> tuple[list[ImageCrop], str]:
    """Return crops of each row's first run, or the reason if there are none, such as missing photos."""
    runs = [row.runs[0] for row in rows]
    settings = runs[0].scene
    try:
        photographs, background = settings.read(runs[0].photographs)
        scene = photographs.downscaled(settings.downscale)
    except (DataError, ConfigError) as error:
        LOG.warning("no crops: %s", error)
        return [], str(error)
    crops = find_crops(runs, scene, background)
    return crops, "" if crops else "no view was rendered by all runs; add `- render` to the stages"


def _figure(crop: ImageCrop) -> dict[str, Any]:
    """Return the crop for the page, with images as data URLs; the crops are PNG, which is lossless."""
    return dict(
        view=crop.view,
        overview=data_url(crop.overview),
        frame=crop.frame,
        photograph=data_url(crop.photograph, ".png"),
        renders=[data_url(image, ".png") for image in crop.renders],
        psnrs=crop.psnrs,
    )
