"""The figures as text, and the time over the number of Gaussians as a chart."""

import statistics
import textwrap
from collections.abc import Sequence
from typing import Any

from clsplat.bench.cases import Result
from clsplat.pages.columns import text_table
from clsplat.pages.svg import Line, curve

SVG_ATTRIBUTES = 'xmlns="http://www.w3.org/2000/svg" width="460" height="220"'
STYLE = "<style>text{font:11px sans-serif;fill:#4a5568}.grid{stroke:#e2e8f0}</style>"


def table(name: str, result: Result, earlier: dict[str, Any] | None) -> str:
    """Return one scene as text; `earlier` is the same scene of an earlier run's JSON."""
    work, mib = result.work, 2**20
    counts = f"{work.gaussians:,} Gaussians, {work.pairs:,} pairs, {work.rows:,} rows, {work.pixels:,} pixels"
    rows = [(stage, ms, result.floors.get(stage)) for stage, ms in result.stages.items()]
    rows += [
        ("host", result.host, None),
        ("step", result.step, sum(result.floors.values())),
        ("densify", result.densify, None),
    ]
    was = {**earlier["stages"], **{key: earlier[key] for key in ("host", "step", "densify")}} if earlier else {}
    cells = [["stage", "ms", "floor", "ratio", *(("was", "now/was") if earlier else ())]]
    for stage, ms, floor in rows:
        ratio = (f"{floor:.2f}", f"{ms / floor:.2f}") if floor else ("", "")
        compared = (f"{was[stage]:.2f}", f"{ms / was[stage]:.2f}") if was.get(stage, 0) > 0 else ()
        cells.append([stage, f"{ms:.2f}", *ratio, *compared])
    memory = f"memory {result.memory / mib:,.0f} MiB at most; training plans {result.planned / mib:,.0f} MiB"
    return f"scene {name}: {counts}\n" + textwrap.indent(f"{text_table(cells, left=1)}\n{memory}", "  ")


def growth_table(results: Sequence[Result]) -> str:
    """Return the milliseconds of steps as text, for growing numbers of Gaussians and pairs, and ns for each."""
    rows = [("Gaussians", "pairs", "ms", "ns each")]
    for result in results:
        work = result.work
        each = 1e6 * result.step / (work.gaussians + work.pairs)
        rows.append((f"{work.gaussians:,}", f"{work.pairs:,}", f"{result.step:.1f}", f"{each:.1f}"))
    return text_table(rows)


def growth_chart(results: Sequence[Result]) -> str:
    """Return the milliseconds of a step over Gaussians + pairs, as SVG."""
    points = [((r.work.gaussians + r.work.pairs) / 1e6, r.step) for r in results]
    slope, x_max = statistics.median(y / x for x, y in points), max(x for x, _ in points)
    lines = [Line(points, "measured"), Line([(0, 0), (x_max, slope * x_max)], "in proportion")]
    drawing = curve("ms per step over millions of Gaussians + pairs", lines)
    return drawing.replace("<svg", f"<svg {SVG_ATTRIBUTES}", 1).replace("</svg>", f"{STYLE}</svg>")
