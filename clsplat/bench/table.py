"""The figures as text, and the time over the number of Gaussians as a chart."""

import statistics
from collections.abc import Sequence
from typing import Any

from clsplat.bench.cases import Result
from clsplat.pages.svg import Line, curve

SVG_ATTRIBUTES = 'xmlns="http://www.w3.org/2000/svg" width="460" height="220"'
STYLE = "<style>text{font:11px sans-serif;fill:#4a5568}.grid{stroke:#e2e8f0}</style>"


def table(name: str, result: Result, earlier: dict[str, Any] | None) -> str:
    """Return one scene as text; `earlier` is the same scene of an earlier run's JSON."""
    work = result.work
    lines = [
        f"scene {name}: {work.gaussians:,} Gaussians, {work.pairs:,} pairs, {work.rows:,} rows, {work.pixels:,} pixels",
        f"  {'stage':<18}{'ms':>9}{'floor':>9}{'ratio':>8}" + ("     was     now/was" if earlier else ""),
    ]
    rows = [(stage, ms, result.floors.get(stage)) for stage, ms in result.stages.items()]
    rows += [
        ("host", result.host, None),
        ("step", result.step, sum(result.floors.values())),
        ("densify", result.densify, None),
    ]
    was = {**earlier["stages"], **{key: earlier[key] for key in ("host", "step", "densify")}} if earlier else {}
    for stage, ms, floor in rows:
        ratio = f"{floor:9.2f}{ms / floor:8.2f}" if floor else " " * 17
        compared = f"{was[stage]:9.2f}{ms / was[stage]:11.2f}" if stage in was and was[stage] > 0 else ""
        lines.append(f"  {stage:<18}{ms:9.2f}{ratio}{compared}")
    mib = 2**20
    lines.append(f"  memory {result.memory / mib:,.0f} MiB at most; training plans {result.planned / mib:,.0f} MiB")
    return "\n".join(lines)


def growth_table(results: Sequence[Result]) -> str:
    """Return the milliseconds of steps as text, for growing numbers of Gaussians and pairs, and ns for each."""
    lines = [f"  {'Gaussians':>11}{'pairs':>11}{'ms':>9}{'ns each':>9}"]
    for result in results:
        work = result.work
        each = 1e6 * result.step / (work.gaussians + work.pairs)
        lines.append(f"  {work.gaussians:11,}{work.pairs:11,}{result.step:9.1f}{each:9.1f}")
    return "\n".join(lines)


def growth_chart(results: Sequence[Result]) -> str:
    """Return the milliseconds of a step over Gaussians + pairs, as SVG."""
    points = [((r.work.gaussians + r.work.pairs) / 1e6, r.step) for r in results]
    slope, x_max = statistics.median(y / x for x, y in points), max(x for x, _ in points)
    lines = [Line(points, "measured"), Line([(0, 0), (x_max, slope * x_max)], "in proportion")]
    drawing = curve("ms per step over millions of Gaussians + pairs", lines)
    return drawing.replace("<svg", f"<svg {SVG_ATTRIBUTES}", 1).replace("</svg>", f"{STYLE}</svg>")
