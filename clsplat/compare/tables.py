"""The tables of a comparison: metrics and costs, means over scenes, differing settings."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean, stdev

from clsplat.compare.comparison import Comparison, Row, Variant
from clsplat.compare.differences import differing
from clsplat.compare.run_folder import RunMetrics
from clsplat.pages.page import duration

METRICS = {  # name -> heading, digits, function that returns the better one
    "psnr": ("PSNR ↑", 2, max),
    "psnr_colour": ("PSNR in the photographs' colours ↑", 2, max),
    "psnr_affine": ("PSNR, colours fitted ↑", 2, max),
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
MAX_SEEDS = 3  # named one by one


@dataclass(frozen=True)
class Cell:
    """A mean as text, with the standard deviation where there are several runs."""

    text: str
    deviation: str = ""
    best: bool = False


@dataclass(frozen=True)
class Column:
    """A figure of each row."""

    heading: str
    cells: list[Cell]


@dataclass(frozen=True)
class Group:
    """Columns under a common title."""

    title: str
    columns: list[Column]


@dataclass(frozen=True)
class Table:
    """A row for each variant."""

    variants: list[Variant]
    groups: list[Group]
    seeds: list[str] = field(default_factory=list)  # by row; empty: not shown


def main_table(rows: Sequence[Row]) -> Table:
    """Return test metrics at the training size, and the costs."""
    costs = [
        *_cost(rows, "Gaussians", lambda metrics: metrics.gaussians),
        *_cost(rows, "parameters", lambda metrics: metrics.parameters),
        Column("steps", _cells([[run.metrics.steps for run in row.runs] for row in rows], 0)),
        Column("training", [Cell(duration(fmean(run.metrics.train_seconds for run in row.runs))) for row in rows]),
        *_cost(rows, "CPU seconds", lambda metrics: metrics.cpu_seconds),
        *_cost(rows, "device memory, MB", lambda metrics: metrics.device_memory and metrics.device_memory / 1e6),
    ]
    return _table(rows, [*_trained_on(rows), Group("", costs)])


def _cost(rows: Sequence[Row], heading: str, cost: Callable[[RunMetrics], float | None]) -> list[Column]:
    """A column of what not all runs note; none where no run does."""
    found = [[cost(run.metrics) for run in row.runs] for row in rows]
    values = [[value for value in row if value is not None] for row in found]
    return [Column(heading, _cells(values, 0))] if any(values) else []


def other_table(rows: Sequence[Row]) -> Table | None:
    """Return the metrics of all other sizes and views; None when there are none."""
    groups = [_group(rows, *one) for one in _measured(rows) if one != ("test", rows[0].downscale)]
    return _table(rows, groups) if groups else None


def downscales(rows: Sequence[Row], split: str) -> list[str]:
    """Return the divisors of the image sizes that any row was measured at, from full size down."""
    found = {downscale for row in rows for downscale in row.downscales(split)}
    return sorted(found, key=lambda text: (float(text), text))


def means_over_scenes(comparison: Comparison) -> Table | None:
    """Return means over the scenes, for variants that ran on all of them; None when there is no such figure."""
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
    return Table([rows[0].variant for rows in complete], [Group("", columns)]) if columns else None


def differing_settings(variants: Sequence[Variant]) -> dict[str, list[str]]:
    """Return the settings that are not the same in all variants: place -> values by variant."""
    places = differing([variant.settings for variant in variants])
    return {place: [variant.settings.get(place, "–") for variant in variants] for place in places}


def differing_conditions(rows: Sequence[Row]) -> Iterable[str]:
    """Yield sentences about conditions that differ, so that figures of a column are not comparable."""
    splits = [split for row in rows for run in row.runs for split in (run.metrics.test, run.metrics.train)]
    averages = [one for split in splits for one in split.values()]
    for key, name in CONDITIONS.items():
        values = {str(value) for one in averages if (value := getattr(one, key, None)) is not None}
        if len(values) > 1:
            yield f"The {name} is not the same in all runs ({', '.join(sorted(values))})."
    for split, downscale in _measured(rows):
        found = [getattr(run.metrics, split).get(downscale) for row in rows for run in row.runs]
        counts = {one.colour_views for one in found if one is not None and one.figure("psnr_colour") is not None}
        if len(counts) > 1:
            name = f"number of {_title(rows, split, downscale)} with a PSNR in the photographs' colours"
            yield f"The {name} is not the same in all runs ({', '.join(map(str, sorted(counts)))})."


def _measured(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """The splits and the divisors of the image sizes that any row was measured at."""
    return [(split, downscale) for split in ("test", "train") for downscale in downscales(rows, split)]


def _trained_on(rows: Sequence[Row]) -> list[Group]:
    """The test metrics at the training size, where they were measured."""
    downscale = rows[0].downscale
    return [_group(rows, "test", downscale)] if downscale in downscales(rows, "test") else []


def _group(rows: Sequence[Row], split: str, downscale: str) -> Group:
    columns = [
        Column(heading, _cells([row.figures(split, downscale, name) for row in rows], digits, best))
        for name, (heading, digits, best) in METRICS.items()
        if any(row.figures(split, downscale, name) for row in rows)
    ]
    return Group(_title(rows, split, downscale), columns)


def _title(rows: Sequence[Row], split: str, downscale: str) -> str:
    size = "full size" if downscale == "1" else f"1/{downscale}"
    return f"{split} views" + ("" if downscale == rows[0].downscale == "1" else f" at {size}")


def _table(rows: Sequence[Row], groups: list[Group]) -> Table:
    return Table([row.variant for row in rows], groups, [_seeds(row) for row in rows])


def _seeds(row: Row) -> str:
    seeds = [str(run.metrics.seed) for run in row.runs]
    return ", ".join(seeds) if len(seeds) <= MAX_SEEDS else f"{len(seeds)} seeds"


def _cells(values: Sequence[list[float]], digits: int, best: Callable[..., float] | None = None) -> list[Cell]:
    """A cell for each list of values; `best` of the means, as they are shown, is marked."""
    means = [round(fmean(row), digits) if row else None for row in values]
    present = [mean for mean in means if mean is not None]
    top = best(present) if best and len(present) > 1 else None
    return [_cell(row, mean, digits, mean == top) for row, mean in zip(values, means, strict=True)]


def _cell(values: list[float], mean: float | None, digits: int, best: bool) -> Cell:
    if mean is None:
        return Cell("–")
    deviation = stdev(values) if len(values) > 1 else 0.0
    return Cell(f"{mean:,.{digits}f}", f"{deviation:,.{digits}f}" if deviation > 0 else "", best)
