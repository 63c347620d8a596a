"""The charts of a comparison: quality and Gaussians over steps and CPU seconds, and quality over image sizes."""

from collections.abc import Callable, Sequence
from statistics import fmean

from markupsafe import Markup

from clsplat.compare import tables
from clsplat.compare.comparison import Row
from clsplat.compare.run_folder import Points, RunFolder
from clsplat.pages.page import charts
from clsplat.pages.svg import COLOURS, Line, curve
from clsplat.training.forecast import VIEWS, over_views

MOST_LINES = len(COLOURS)  # that are told apart one by one


def curves(rows: Sequence[Row]) -> list[Markup]:
    """PSNR and Gaussians over steps, a line for each run, or, of many, for each variant; then quality over sizes."""
    downscale = rows[0].runs[0].scene.downscale
    are_many = sum(len(row.runs) for row in rows) > MOST_LINES
    means = " (means)" if are_many and any(len(row.runs) > 1 for row in rows) else ""

    def lines(points_of: Callable[[RunFolder], Points]) -> list[Line]:
        if are_many:
            of_rows = [_mean([points_of(run) for run in row.runs]) for row in rows]
            return [
                Line(points, row.variant.letter, row.variant.colour, i // len(COLOURS))
                for i, (row, points) in enumerate(zip(rows, of_rows, strict=True))
                if len(dict(points)) > 1
            ]
        return [
            Line(points, name, row.variant.colour, i)
            for row in rows
            for i, (run, name) in enumerate(zip(row.runs, _names(row), strict=True))
            if len(dict(points := points_of(run))) > 1  # steps: one is no line
        ]

    def tested(run: RunFolder) -> Points:
        return run.points("evaluate", "psnr", split="test", downscale=downscale)

    def trained(run: RunFolder) -> Points:
        points = run.points("train", "psnr")
        return list(zip([step for step, _ in points], over_views([psnr for _, psnr in points]), strict=True))

    drawings = [
        curve(f"test PSNR over steps, dB{means}", lines(tested)),
        curve(f"test PSNR over CPU seconds of training, dB{means}", lines(lambda run: run.by_cpu_seconds(tested(run)))),
        curve(f"training PSNR over steps, mean of {VIEWS} views, dB{means}", lines(trained)),
        curve(f"Gaussians over steps{means}", lines(lambda run: run.points("train", "gaussians"))),
    ]
    return charts(drawings + _size_charts(rows, "test") + _size_charts(rows, "train"))


def _mean(lines: Sequence[Points]) -> Points:
    """The means of lines, point by point, as far as all go."""
    return [(fmean(x for x, _ in points), fmean(y for _, y in points)) for points in zip(*lines, strict=False)]


def _names(row: Row) -> list[str]:
    """The names of a row's lines where it has several runs: their seeds, or the folders of runs with one seed."""
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


def _size_charts(rows: Sequence[Row], split: str) -> list[str]:
    """PSNR and SSIM over image sizes, a line for each variant."""
    sizes = tables.downscales(rows, split)
    if len(sizes) < 2:
        return []
    ticks = {float(i): "full size" if size == "1" else f"1/{size}" for i, size in enumerate(sizes)}
    drawings = []
    for metric, title in (("psnr", f"{split} PSNR by image size, dB"), ("ssim", f"{split} SSIM by image size")):
        lines = []
        for row in rows:
            found = [(float(i), row.figures(split, size, metric)) for i, size in enumerate(sizes)]
            lines.append(Line([(i, fmean(values)) for i, values in found if values], colour=row.variant.colour))
        drawings.append(curve(title, lines, ticks=ticks))
    return drawings
