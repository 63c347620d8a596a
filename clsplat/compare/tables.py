"""The tables of a comparison: who is who, metrics, differing settings, folders."""

import html
from collections.abc import Callable, Sequence
from statistics import fmean, stdev

from clsplat.compare.comparison import Comparison, Row, Variant
from clsplat.compare.differences import differing
from clsplat.pages.page import duration

METRICS = {  # name -> heading, digits, which is better
    "psnr": ("PSNR ↑", 2, max),
    "ssim": ("SSIM ↑", 4, max),
    "ms_ssim": ("MS-SSIM ↑", 4, max),
    "flip": ("FLIP ↓", 4, min),
    "lpips": ("LPIPS ↓", 4, min),
}
REMARKS = {"lpips_input": "input range of LPIPS", "lpips_model": "LPIPS network"}
STYLE = """
.wide{overflow-x:auto}table.data th{font-weight:500;color:#4a5568;font-size:.85rem;white-space:nowrap}
table.data td{white-space:nowrap;font-variant-numeric:tabular-nums}table.data tr{border-bottom:1px solid #e2e8f0}
table.data .best{font-weight:700}table.data small{font-weight:400;color:#718096;font-size:.8rem}
table.data .first{padding-left:1.2rem}table.settings td{max-width:18rem;white-space:normal;overflow-wrap:anywhere}
.chip{display:inline-block;min-width:1.2rem;padding:0 .15rem;border-radius:4px;color:#fff;text-align:center;
font-size:.8rem;line-height:1.2rem}.note{color:#9c4221;background:#fffaf0;padding:.4rem .8rem;border-radius:6px}
"""


def chip(variant: Variant) -> str:
    """The letter of a variant on its colour."""
    return f'<b class=chip style="background:{variant.colour}">{variant.letter}</b>'


def label(variant: Variant) -> str:
    """Letter and name."""
    return f"{chip(variant)} {html.escape(variant.name)}"


def metrics(rows: Sequence[Row]) -> str:
    """Test metrics at the size trained on with the costs, then all else that was measured; the best are bold."""
    costs = [
        ("Gaussians", _column([[run.metrics.gaussians for run in row.runs] for row in rows], 0)),
        ("steps", _column([[run.metrics.steps for run in row.runs] for row in rows], 0)),
        ("training", [f"<td>{duration(fmean(run.metrics.train_seconds for run in row.runs))}" for row in rows]),
    ]
    scale = rows[0].scale
    groups = [("test", scale)] if scale in scales(rows, "test") else []
    more = [
        (split, scale) for split in ("test", "train") for scale in scales(rows, split) if (split, scale) not in groups
    ]
    tables = _metric_table(rows, groups, costs)
    if more:
        tables += f"<h3>Other sizes and views</h3>{_metric_table(rows, more, [])}"
    spread = "mean ± standard deviation over seeds; " if any(len(row.runs) > 1 for row in rows) else ""
    return f"<p class=sub>{spread}bold: the best</p>{tables}{_remarks(rows)}"


def _metric_table(
    rows: Sequence[Row], groups: Sequence[tuple[str, str]], costs: Sequence[tuple[str, list[str]]]
) -> str:
    """A row for each variant; columns are metrics, grouped by (split, scale), and then `costs`."""
    above, titles, columns = "", "", []
    for split, scale in groups:
        shown = [name for name in METRICS if any(row.figures(split, scale, name) for row in rows)]
        size = "" if scale == "1" else f" at 1/{scale}"
        above += f"<th class=first colspan={len(shown)}>{split} views{size}"
        for name in shown:
            title, digits, best = METRICS[name]
            titles += f"<th{' class=first' if name == shown[0] else ''}>{title}"
            columns.append(_column([row.figures(split, scale, name) for row in rows], digits, best))
    titles += "".join(f"<th{' class=first' if i == 0 else ''}>{title}" for i, (title, _) in enumerate(costs))
    columns += [column for _, column in costs]
    body = "".join(
        f"<tr><td>{label(row.variant)}<td>{_seeds(row)}{''.join(column[i] for column in columns)}"
        for i, row in enumerate(rows)
    )
    return f"<div class=wide><table class=data><tr><th><th>{above}<tr><th>run<th>seeds{titles}{body}</table></div>"


def _seeds(row: Row) -> str:
    seeds = [str(run.metrics.seed) for run in row.runs]
    return ", ".join(seeds) if len(seeds) <= 3 else f"{len(seeds)} seeds"


def over_scenes(comparison: Comparison) -> str:
    """Means over the scenes, of the variants that were run on all of them."""
    scenes = list(comparison.scenes.values())
    everywhere = [[row for rows in scenes for row in rows if row.variant is v] for v in comparison.variants]
    complete = [rows for rows in everywhere if len(rows) == len(scenes)]
    if not complete:
        return ""
    head, columns = "", []
    for name, (title, digits, best) in METRICS.items():
        means = [
            [fmean(values) for row in rows if (values := row.figures("test", row.scale, name))] for rows in complete
        ]
        if all(len(values) == len(scenes) for values in means):
            head += f"<th>{title}"
            columns.append(_column([[fmean(values)] for values in means], digits, best))
    if not columns:
        return ""
    body = "".join(
        f"<tr><td>{label(rows[0].variant)}{''.join(c[i] for c in columns)}" for i, rows in enumerate(complete)
    )
    return (
        f"<h2>Mean of {len(scenes)} scenes</h2><p class=sub>test views, at the size trained on</p>"
        f"<div class=wide><table class=data><tr><th>run{head}{body}</table></div>"
    )


def settings(variants: Sequence[Variant]) -> str:
    """The settings that are not the same in all variants."""
    places = differing([variant.settings for variant in variants])
    if not places:
        return "<h2>Settings</h2><p class=sub>All runs have the same settings, but for scene and seed.</p>"
    head = "".join(f"<th>{chip(variant)}" for variant in variants)
    body = "".join(
        f"<tr><td>{html.escape(place)}"
        + "".join(f"<td>{html.escape(variant.settings.get(place, '–'))}" for variant in variants)
        for place in places
    )
    return (
        "<h2>Settings that differ</h2><p class=sub>– means that the pipeline has no such setting</p>"
        f'<div class=wide><table class="data settings"><tr><th>setting{head}{body}</table></div>'
    )


def folders(comparison: Comparison) -> str:
    """Where the runs lie."""
    body = "".join(
        f"<tr><td>{chip(comparison.variant(run))} {html.escape(str(run.path))}<td>{run.metrics.seed}"
        for run in comparison.runs
    )
    return f"<h2>Runs</h2><div class=wide><table class=data><tr><th>folder<th>seed{body}</table></div>"


def scales(rows: Sequence[Row], split: str) -> list[str]:
    """The downscale factors of any row, from full size down."""
    return sorted({scale for row in rows for scale in row.scales(split)}, key=float)


def _column(cells: Sequence[list[float]], digits: int, best: Callable[..., float] | None = None) -> list[str]:
    means = [round(fmean(values), digits) if values else None for values in cells]
    present = [mean for mean in means if mean is not None]
    top = best(present) if best and len(present) > 1 else None
    return [
        _cell(values, mean, digits, mean is not None and mean == top) for values, mean in zip(cells, means, strict=True)
    ]


def _cell(values: list[float], mean: float | None, digits: int, is_best: bool) -> str:
    if mean is None:
        return "<td>–"
    spread = f" <small>± {stdev(values):,.{digits}f}</small>" if len(values) > 1 and stdev(values) > 0 else ""
    return f"<td{' class=best' if is_best else ''}>{mean:,.{digits}f}{spread}"


def _remarks(rows: Sequence[Row]) -> str:
    """What makes figures of one column incomparable."""
    averages = [
        a for row in rows for run in row.runs for split in (run.metrics.test, run.metrics.train) for a in split.values()
    ]
    text = ""
    for key, name in REMARKS.items():
        values = {str(value) for average in averages if (value := getattr(average, key, None)) is not None}
        if len(values) > 1:
            text += (
                f"<p class=note>The {name} is not the same in all runs ({html.escape(', '.join(sorted(values)))}).</p>"
            )
    return text
