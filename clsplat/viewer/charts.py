"""Small line charts as inline SVG."""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 460, 220  # px
LEFT, BOTTOM, TOP, RIGHT = 56, 30, 26, 12
COLORS = ("#2b6cb0", "#c05621", "#2f855a", "#805ad5", "#b83280", "#0f8a9d", "#8a6d1b", "#4a5568")
DASHES = (("", ""), ("7 4", "dashed"), ("2 3", "dotted"), ("9 3 2 3", "dash-dotted"))  # of a stroke, and in words
MAX_MARKED_POINTS = 12  # of a line; a longer one shows no circles
LEGEND_ROW, LEGEND_LETTERS = 14, 66  # px of a row; letters that fit in one, about


@dataclass(frozen=True)
class Line:
    """Points (x, y) in the order in which they are joined."""

    points: Sequence[tuple[float, float]]
    name: str = ""  # in the legend
    color: str = ""  # by default the next one
    dash: int = 0  # place in DASHES, for lines of one color


def curve(
    title: str, lines: Sequence[Line], logarithmic: bool = False, ticks: Mapping[float, str] | None = None
) -> str:
    """Draw lines over common axes; a logarithmic y axis drops values that are not positive.

    `ticks` name places on the x axis, which has numbers otherwise.  Without points the chart is "".
    """
    drawn = [_drawn(line, logarithmic) for line in lines]
    drawn = [line for line in drawn if line.points]
    if not drawn:
        return ""
    legend = _legend(drawn)
    top = TOP + LEGEND_ROW * len(legend)
    xs = [x for line in drawn for x, _ in line.points]
    ys = [y for line in drawn for _, y in line.points]
    x_low, x_high = 0.0, max(xs) or 1.0
    y_low, y_high = min(ys), max(ys)
    if y_high == y_low:
        y_low, y_high = y_low - 0.5, y_high + 0.5

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_low) / (x_high - x_low)
        up = (y - y_low) / (y_high - y_low)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - BOTTOM - top)

    parts = _begun(title)
    for i, row in enumerate(legend, 1):
        parts.append(f'<text x="{LEFT}" y="{15 + LEGEND_ROW * i}">{row}</text>')
    counts = not logarithmic and _are_whole(ys)
    rows = _decade_ticks(y_low, y_high) if logarithmic else _ticks(y_low, y_high, counts)
    for tick, label in zip(rows, _numbers([10**row if logarithmic else row for row in rows], counts), strict=True):
        _, y = place(x_low, tick)
        parts += _row(y, label)
    steps = _are_whole(xs)
    columns = _ticks(x_low, x_high, steps)
    for tick, label in (ticks or dict(zip(columns, _numbers(columns, steps), strict=True))).items():
        x, _ = place(tick, y_low)
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 10}" text-anchor="middle">{html.escape(label)}</text>')
    for i, line in enumerate(drawn):
        color, (dash, _) = _color(line, i), _dash(line)
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        places = [place(*point) for point in line.points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.8"{dashed}/>')
        if len(places) <= MAX_MARKED_POINTS:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{color}"/>' for x, y in places]
    return "".join([*parts, "</svg>"])


def histogram(title: str, values: Sequence[float], bins: int = 24) -> str:
    """Draw the number of values in each of `bins` equal intervals from zero; without values the chart is ""."""
    if not values:
        return ""
    high = max(values) or 1.0
    counts = [0] * bins
    for value in values:
        counts[min(bins - 1, int(bins * value / high))] += 1
    width, height = WIDTH - LEFT - RIGHT, HEIGHT - BOTTOM - TOP
    parts = _begun(title)
    rows = _ticks(0, max(counts), whole=True)
    for tick, label in zip(rows, _numbers(rows, whole=True), strict=True):
        parts += _row(HEIGHT - BOTTOM - tick / max(counts) * height, label)
    for i, count in enumerate(counts):
        if count:
            tall = count / max(counts) * height
            place = f'x="{LEFT + i * width / bins + 1:.1f}" y="{HEIGHT - BOTTOM - tall:.1f}"'
            parts.append(f'<rect {place} width="{width / bins - 2:.1f}" height="{tall:.1f}" fill="{COLORS[0]}"/>')
    columns = _ticks(0, high)
    for tick, label in zip(columns, _numbers(columns), strict=True):
        x = LEFT + tick / high * width
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 10}" text-anchor="middle">{label}</text>')
    return "".join([*parts, "</svg>"])


def _begun(title: str) -> list[str]:
    """The start of a drawing with its title."""
    start = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">'
    return [start, f'<text x="{LEFT}" y="15" class="title">{html.escape(title)}</text>']


def _row(y: float, label: str) -> list[str]:
    """A line across the chart at a tick of the y axis, and its label."""
    line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>'
    return [line, f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>']


def _drawn(line: Line, logarithmic: bool) -> Line:
    """The line in the coordinates of the axes: its points that are finite."""
    points = [(x, y) for x, y in line.points if math.isfinite(x) and math.isfinite(y)]
    return replace(line, points=[(x, math.log10(y)) for x, y in points if y > 0] if logarithmic else points)


def _color(line: Line, index: int) -> str:
    return line.color or COLORS[index % len(COLORS)]


def _dash(line: Line) -> tuple[str, str]:
    return DASHES[line.dash % len(DASHES)]


def _legend(lines: Sequence[Line]) -> list[str]:
    """Rows of names in their lines' colors; none for a single line."""
    rows: list[str] = []
    room = 0
    for i, line in enumerate(lines if len(lines) > 1 else []):
        if not line.name:
            continue
        name = line.name + (f" ({word})" if (word := _dash(line)[1]) else "")
        if len(name) > room:
            rows.append("")
            room = LEGEND_LETTERS
        gap = ' dx="12"' if rows[-1] else ""
        rows[-1] += f'<tspan{gap} style="fill:{_color(line, i)}">{html.escape(name)}</tspan>'
        room -= len(name) + 2
    return rows


def _are_whole(values: Sequence[float]) -> bool:
    return all(float(value).is_integer() for value in values)


def _ticks(low: float, high: float, whole: bool = False) -> list[float]:
    """Three to six round numbers between low and high; fewer where there are fewer whole ones."""
    rough = max((high - low) / 4, 1.0 if whole else 0.0)
    power = 10 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _decade_ticks(low: float, high: float) -> list[float]:
    """Logarithms of 1, 2 and 5 times powers of ten between low and high, or, if there are not two, of round numbers."""
    powers = range(math.floor(low), math.ceil(high) + 1)
    ticks = [t for p in powers for m in (1, 2, 5) if low <= (t := p + math.log10(m)) <= high]
    return ticks if len(ticks) > 1 else [math.log10(tick) for tick in _ticks(10**low, 10**high)]


def _numbers(values: Sequence[float], whole: bool = False) -> list[str]:
    """Labels of ticks, with the digits that tell them apart: 100k, 100.2k, not 100k twice; whole: 8,040, not 8.04k."""
    if whole and any(value % 100 for value in values):
        return [f"{value:,.0f}" for value in values]
    found = [[_number(value, digits) for value in values] for digits in range(3, 10)]
    return next((labels for labels in found if len(set(labels)) == len(set(values))), found[-1])


def _number(value: float, digits: int) -> str:
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:.{digits}g}{suffix}"
    return f"{value:.{digits}g}"


# Cameras and points on a plane, as inline SVG.

PLAN_WIDTH, PLAN_HEIGHT, MARGIN, TITLE = 460, 340, 18, 26  # px
LENGTH, SPREAD = 11.0, 0.45  # of a camera's triangle, px, and half of its opening by its length


@dataclass(frozen=True)
class Marks:
    """Cameras of one kind."""

    name: str
    centers: NDArray[np.float64]  # [M, 2], scene units
    directions: NDArray[np.float64]  # [M, 2]


def plan(title: str, marks: Sequence[Marks], points: NDArray[np.float64]) -> str:
    """Draw points [N, 2], and each camera as a triangle that opens where it looks.  Both axes have one scale."""
    everything = np.concatenate([points, *(one.centers for one in marks)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = np.array([PLAN_WIDTH - 2 * MARGIN, PLAN_HEIGHT - TITLE - 2 * MARGIN])
    scale = float((room / np.maximum(high - low, 1e-12)).min())
    corner = np.array([MARGIN, MARGIN + TITLE]) + (room - scale * (high - low)) / 2

    def placed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(corner + scale * (values - low))

    parts = [f'<svg viewBox="0 0 {PLAN_WIDTH} {PLAN_HEIGHT}" role="img" aria-label="{html.escape(title)}">']
    parts.append(f'<text x="{MARGIN}" y="18" class="title">{html.escape(title)}</text>')
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in placed(points))
    parts.append(f'<path d="{dots}" class="dots"/>')
    for i, one in enumerate(marks):
        color = COLORS[i % len(COLORS)]
        shapes = "".join(map(_triangle, placed(one.centers), one.directions))
        parts.append(f'<path d="{shapes}" fill="{color}" fill-opacity=".75" stroke="{color}"/>')
        name = f"{len(one.centers)} {one.name}"
        parts.append(
            f'<text x="{PLAN_WIDTH - MARGIN}" y="{18 + 14 * i}" text-anchor="end" style="fill:{color}">'
            f"{html.escape(name)}</text>"
        )
    return "".join([*parts, "</svg>"])


def _triangle(at: NDArray[np.float64], direction: NDArray[np.float64]) -> str:
    """A path; shorter for a camera that looks up or down."""
    ahead = LENGTH * direction
    aside = SPREAD * LENGTH * np.array([-direction[1], direction[0]]) / (float(np.linalg.norm(direction)) or 1.0)
    (x, y), (a, b), (c, d) = at, at + ahead + aside, at + ahead - aside
    return f"M{x:.1f} {y:.1f}L{a:.1f} {b:.1f}L{c:.1f} {d:.1f}Z"
