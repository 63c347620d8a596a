"""Write an offline page that compares runs side by side: metrics, curves, crops, and differing settings."""

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
from clsplat.core.page import data_url, duration_text, mark_charts_safe, render
from clsplat.pipeline.file import SceneSettings
from clsplat.runs.results import Curve, RunFolder, RunMetrics
from clsplat.sweeps.compare.comparison import PublishedTable, RunComparison, Variant, VariantRow, differing_keys
from clsplat.sweeps.compare.crops import ImageCrop, find_crops
from clsplat.training.records import PSNR_REPORTS, moving_average
from clsplat.viewer.charts import COLORS, Line, line_chart

# The tables: metrics and costs, means over scenes, differing settings.

METRICS = {  # by name: heading, number of decimals, and the function that selects the best value
    "psnr": ("PSNR ↑", 2, max),
    "psnr_color": ("PSNR in the photos' colors ↑", 2, max),
    "psnr_affine": ("PSNR, colors fitted ↑", 2, max),
    "psnr_held_out_moments": ("PSNR, held-out timestamps ↑", 2, max),
    "psnr_other_moments": ("PSNR, other timestamps ↑", 2, max),
    "psnr_static": ("PSNR, static pixels ↑", 2, max),
    "flicker": ("flicker of static pixels, levels ↓", 2, min),
    "ssim": ("SSIM ↑", 4, max),
    "ms_ssim": ("MS-SSIM ↑", 4, max),
    "flip": ("FLIP ↓", 4, min),
    "lpips": ("LPIPS ↓", 4, min),
}
CONDITIONS = {"lpips_input": "input range of LPIPS", "lpips_model": "LPIPS network"}
MAX_SEEDS = 3  # if a row has more seeds, only their number is shown


@dataclass(frozen=True)
class TableCell:
    """A mean formatted as text, with the standard deviation if there is more than one run."""

    text: str
    deviation: str = ""
    is_best: bool = False


@dataclass(frozen=True)
class Column:
    """A column of a table, with one cell per row."""

    heading: str
    cells: list[TableCell]


@dataclass(frozen=True)
class Group:
    """A group of columns under a common title."""

    title: str
    columns: list[Column]


@dataclass(frozen=True)
class MetricTable:
    """A table of metrics, with one row per variant."""

    variants: list[Variant]
    groups: list[Group]
    seeds: list[str] = field(default_factory=list)  # one text per row; if empty, there is no column of seeds


def main_table(rows: Sequence[VariantRow]) -> MetricTable:
    """Return the table of test metrics at the training size, and costs such as time and memory."""
    cost_columns = [
        *_cost(rows, "Gaussians", lambda metrics: metrics.gaussians),
        *_cost(rows, "parameters", lambda metrics: metrics.parameters),
        Column("steps", _to_table_cells([[run.metrics.steps for run in row.runs] for row in rows], 0)),
        Column("training", [TableCell(duration_text(_train_seconds(row))) for row in rows]),
        *_cost(rows, "CPU seconds", lambda metrics: metrics.cpu_seconds),
        *_cost(rows, "device memory, MB", lambda metrics: metrics.device_memory and metrics.device_memory / 1e6),
    ]
    return _table(rows, [*_training_size(rows), Group("", cost_columns)])


def _train_seconds(row: VariantRow) -> float:
    return fmean(run.metrics.train_seconds for run in row.runs)


def _cost(rows: Sequence[VariantRow], heading: str, cost: Callable[[RunMetrics], float | None]) -> list[Column]:
    """Return the column of a cost as a list, which is empty if no run recorded the cost."""
    optional_values = [[cost(run.metrics) for run in row.runs] for row in rows]
    values = [[value for value in row if value is not None] for row in optional_values]
    return [Column(heading, _to_table_cells(values, 0))] if any(values) else []


def other_tables(rows: Sequence[VariantRow]) -> list[MetricTable]:
    """Return the tables of metrics at other sizes and for other splits: one per split, so that each fits the page."""
    by_split: dict[str, list[Group]] = {}
    for split, downscale in _measured_sizes(rows):
        if (split, downscale) != ("test", rows[0].downscale):
            by_split.setdefault(split, []).append(_group(rows, split, downscale))
    return [_table(rows, groups) for groups in by_split.values()]


def downscales(rows: Sequence[VariantRow], split: str) -> list[str]:
    """Return the divisors of the image size at which any row was evaluated, from the largest images to the smallest."""
    divisors = {downscale for row in rows for downscale in row.downscales(split)}
    return sorted(divisors, key=lambda divisor: (float(divisor), divisor))


def means_over_scenes(comparison: RunComparison) -> MetricTable | None:
    """Return the table of means over scenes, with the variants that have runs on all scenes.

    Returns None if there is no metric that was measured on all scenes.
    """
    scenes = list(comparison.scenes.values())
    rows_by_variant = [[row for rows in scenes for row in rows if row.variant is v] for v in comparison.variants]
    groups = [rows for rows in rows_by_variant if len(rows) == len(scenes)]
    columns = []
    for name, (heading, digits, choose_best) in METRICS.items():
        means = [
            [fmean(values) for row in rows if (values := row.values("test", row.downscale, name))] for rows in groups
        ]
        if means and all(len(values) == len(scenes) for values in means):
            columns.append(Column(heading, _to_table_cells([[fmean(values)] for values in means], digits, choose_best)))
    return MetricTable([rows[0].variant for rows in groups], [Group("", columns)]) if columns else None


def differing_settings(variants: Sequence[Variant]) -> dict[str, list[str]]:
    """Return the settings that differ between variants, as lists with the value of each variant, by key path."""
    key_paths = differing_keys([variant.settings for variant in variants])
    return {key_path: [variant.settings.get(key_path, "–") for variant in variants] for key_path in key_paths}


def differing_conditions(rows: Sequence[VariantRow]) -> Iterable[str]:
    """Yield a sentence for each condition of the measurement that differs, which makes metrics incomparable."""
    splits = [split for row in rows for run in row.runs for split in (run.metrics.test, run.metrics.train)]
    averages = [mean for split in splits for mean in split.values()]
    for key, name in CONDITIONS.items():
        values = {str(value) for mean in averages if (value := getattr(mean, key, None)) is not None}
        if len(values) > 1:
            yield f"The {name} differs between runs ({', '.join(sorted(values))})."
    for split, downscale in _measured_sizes(rows):
        means = [getattr(run.metrics, split).get(downscale) for row in rows for run in row.runs]
        counts = {mean.color_views for mean in means if mean is not None and mean.value("psnr_color") is not None}
        if len(counts) > 1:
            name = f"number of {_title(rows, split, downscale)} with a PSNR in the photos' colors"
            yield f"The {name} differs between runs ({', '.join(map(str, sorted(counts)))})."


def _measured_sizes(rows: Sequence[VariantRow]) -> list[tuple[str, str]]:
    """Return the pairs of split and image-size divisor at which any row was evaluated."""
    return [(split, downscale) for split in ("test", "train") for downscale in downscales(rows, split)]


def _training_size(rows: Sequence[VariantRow]) -> list[Group]:
    """Return the column group of test metrics at the training size as a list, which is empty if there are none."""
    downscale = rows[0].downscale
    return [_group(rows, "test", downscale)] if downscale in downscales(rows, "test") else []


def _group(rows: Sequence[VariantRow], split: str, downscale: str) -> Group:
    columns = [
        Column(heading, _to_table_cells([row.values(split, downscale, name) for row in rows], digits, choose_best))
        for name, (heading, digits, choose_best) in METRICS.items()
        if any(row.values(split, downscale, name) for row in rows)
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


def _to_table_cells(
    values: Sequence[list[float]], digits: int, choose: Callable[..., float] | None = None
) -> list[TableCell]:
    """Return a cell with the mean of each list of values.  The best of the rounded means is marked.

    digits: number of decimals.  choose: returns the best of several means; None: mark no cell.
    """
    means = [round(fmean(row), digits) if row else None for row in values]
    available_means = [mean for mean in means if mean is not None]
    best_mean = choose(available_means) if choose and len(available_means) > 1 else None
    return [_to_table_cell(row, mean, digits, mean == best_mean) for row, mean in zip(values, means, strict=True)]


def _to_table_cell(values: list[float], mean: float | None, digits: int, is_best: bool) -> TableCell:
    if mean is None:
        return TableCell("–")
    deviation = stdev(values) if len(values) > 1 else 0.0
    return TableCell(f"{mean:,.{digits}f}", f"{deviation:,.{digits}f}" if deviation > 0 else "", is_best)


# The charts: quality and Gaussians over steps and CPU seconds, and quality over image sizes.

MAX_LINES = len(COLORS)  # of a chart; if there are more runs, each line is the mean of a variant


def draw_curves(rows: Sequence[VariantRow]) -> list[Markup]:
    """Draw charts of PSNR and the number of Gaussians during training, and of metrics over image sizes, as SVG.

    Charts of the training have a line per run, or per variant if there are more than MAX_LINES runs.
    """
    downscale = rows[0].runs[0].scene.downscale
    shows_means = sum(len(row.runs) for row in rows) > MAX_LINES
    suffix = " (means)" if shows_means and any(len(row.runs) > 1 for row in rows) else ""

    def lines(get_points: Callable[[RunFolder], Curve]) -> list[Line]:
        if shows_means:
            row_means = [_mean([get_points(run) for run in row.runs]) for row in rows]
            return [
                Line(points, row.variant.letter, row.variant.color, i // len(COLORS))
                for i, (row, points) in enumerate(zip(rows, row_means, strict=True))
                if len(dict(points)) > 1
            ]
        return [
            Line(points, name, row.variant.color, i)
            for row in rows
            for i, (run, name) in enumerate(zip(row.runs, _names(row), strict=True))
            if len(dict(points := get_points(run))) > 1  # a single point is not a line
        ]

    def test_points(run: RunFolder) -> Curve:
        return run.curve("evaluate", "psnr", split="test", downscale=downscale)

    def training_points(run: RunFolder) -> Curve:
        points = run.curve("train", "psnr")
        return list(zip([step for step, _ in points], moving_average([psnr for _, psnr in points]), strict=True))

    charts = [
        line_chart(f"test PSNR over steps, dB{suffix}", lines(test_points)),
        line_chart(
            f"test PSNR over CPU seconds of training, dB{suffix}",
            lines(lambda run: run.over_cpu_seconds(test_points(run))),
        ),
        line_chart(f"training PSNR over steps, mean of {PSNR_REPORTS} views, dB{suffix}", lines(training_points)),
        line_chart(f"Gaussians over steps{suffix}", lines(lambda run: run.curve("train", "gaussians"))),
    ]
    return mark_charts_safe(charts + _size_charts(rows, "test") + _size_charts(rows, "train"))


def _mean(lines: Sequence[Curve]) -> Curve:
    """Return the pointwise mean of several lines, up to the end of the shortest line."""
    return [(fmean(x for x, _ in points), fmean(y for _, y in points)) for points in zip(*lines, strict=False)]


def _names(row: VariantRow) -> list[str]:
    """Return the names of the lines of a row with several runs: their seeds, or their folders if seeds repeat."""
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
    """Draw charts of PSNR and SSIM over image sizes, with one line per variant, as SVG."""
    sizes = downscales(rows, split)
    if len(sizes) < 2:
        return []
    ticks = {float(i): "full size" if size == "1" else f"1/{size}" for i, size in enumerate(sizes)}
    charts = []
    for metric, title in (("psnr", f"{split} PSNR by image size, dB"), ("ssim", f"{split} SSIM by image size")):
        lines = []
        for row in rows:
            points = [(float(i), row.values(split, size, metric)) for i, size in enumerate(sizes)]
            lines.append(Line([(i, fmean(values)) for i, values in points if values], color=row.variant.color))
        charts.append(line_chart(title, lines, ticks=ticks))
    return charts


LOG = logging.getLogger("clsplat")
MAX_NAMES = 4  # number of pipelines in the title


def write_comparison(
    paths: Sequence[Path],
    out: Path,
    title: str = "",
    remarks: Sequence[str] = (),
    published: Sequence[PublishedTable] = (),
) -> int:
    """Write a page that compares run folders; return the number of runs.

    remarks: sentences to show at the top.  Raises the errors of `RunComparison.read`.
    """
    comparison = RunComparison.read(paths)
    warnings = [warning for run in comparison.runs for warning in run.plugin_faults]
    for warning in warnings:
        LOG.warning("%s", warning)
    write_text(out, comparison_page(comparison, title, [*remarks, *warnings], out.parent, published))
    return len(comparison.runs)


def comparison_page(
    comparison: RunComparison,
    title: str,
    remarks: Sequence[str],
    folder: Path,
    published: Sequence[PublishedTable] = (),
) -> str:
    """Return the HTML of the page.

    title: "" for the names of the pipelines.  remarks: sentences to show at the top.  folder: the folder of the page,
    to which links are relative.
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
        runs=[(comparison.variant(run), str(run.path), run.metrics.seed, _make_links(run, folder)) for run in runs],
    )


def _make_links(run: RunFolder, folder: Path) -> dict[str, str]:
    """Return the links to the report and the viewer page of a run, relative to a folder."""
    files = {stage: run.path / run.metrics.files.get(stage, "") for stage in ("report", "viewer")}
    return {
        stage: quote(Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix())
        for stage, file in files.items()
        if file.is_file()
    }


def _section(name: str, rows: Sequence[VariantRow]) -> dict[str, Any]:
    """Return the values of the template for the section of a scene."""
    crops, no_crops = _find_page_crops(rows)
    has_several_seeds = any(len(row.runs) > 1 for row in rows)
    explanations = ["mean ± standard deviation over seeds"] if has_several_seeds else []
    return dict(
        name=name,
        variants=[row.variant for row in rows],
        several_seeds=has_several_seeds,
        explanations=[*_sizes(rows[0].runs[0].scene), *explanations, *(["bold: the best"] if len(rows) > 1 else [])],
        remarks=list(differing_conditions(rows)),
        main=main_table(rows),
        others=other_tables(rows),
        curves=draw_curves(rows),
        crops=[_crop_values(crop) for crop in crops],
        no_crops=no_crops,
    )


def _sizes(scene: SceneSettings) -> list[str]:
    """Return a list with a line that explains the image sizes, or an empty list if all runs used the full size."""
    first, *others = (f"1/{downscale:g}" if downscale != 1 else "full size" for downscale in scene.downscales)
    if first == "full size" and not others:
        return []
    return [f"sizes are relative to the original photos; trained at {', '.join([first, *others])}"]


def _find_page_crops(rows: Sequence[VariantRow]) -> tuple[list[ImageCrop], str]:
    """Return the crops of the first run of each row, and the reason if there are none, else ""."""
    runs = [row.runs[0] for row in rows]
    settings = runs[0].scene
    try:
        original, background = settings.read(runs[0].photo_folder)
        scene = original.downscaled(settings.downscale)
    except (DataError, ConfigError) as error:
        LOG.warning("the page has no crops: %s", error)
        return [], str(error)
    crops = find_crops(runs, scene, background)
    return crops, "" if crops else "no view was rendered by all runs; add `- render` to the stages"


def _crop_values(crop: ImageCrop) -> dict[str, Any]:
    """Return the values of the template for a crop.  Images are data URLs; the crops are PNG, which is lossless."""
    return dict(
        view=crop.view,
        overview=data_url(crop.overview),
        percentages=crop.percentages,
        photograph=data_url(crop.photograph, ".png"),
        renders=[data_url(image, ".png") for image in crop.renders],
        psnrs=crop.psnrs,
    )
