"""Draw small charts as inline SVG: lines, histograms, and camera plans."""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.view import View
from clsplat.scene.viewpoint import perpendicular, up_direction

WIDTH, HEIGHT = 460, 220  # px
LEFT, BOTTOM, TOP, RIGHT = 56, 30, 26, 12
COLORS = ("#2b6cb0", "#c05621", "#2f855a", "#805ad5", "#b83280", "#0f8a9d", "#8a6d1b", "#4a5568")
DASHES = (("", ""), ("7 4", "dashed"), ("2 3", "dotted"), ("9 3 2 3", "dash-dotted"))  # stroke-dasharray, description
MAX_MARKED_POINTS = 12  # lines with more points have no circles
LEGEND_ROW, LEGEND_LETTERS = 14, 66  # height of a row, px; approximate number of letters per row


@dataclass(frozen=True)
class Line:
    """A line of a chart: its points (x, y) in order, its name, and its style."""

    points: Sequence[tuple[float, float]]
    name: str = ""  # in the legend
    color: str = ""  # default: the next of COLORS
    dash: int = 0  # index into DASHES, for lines of the same color


def line_chart(
    title: str, lines: Sequence[Line], logarithmic: bool = False, ticks: Mapping[float, str] | None = None
) -> str:
    """Return a line chart as SVG, or "" if all points have the same x or the same y.

    logarithmic: use a logarithmic y axis, and omit values that are not positive.
    ticks: labels of the x axis, by position; default: numbers.
    """
    axis_lines = [_to_axes(line, logarithmic) for line in lines]
    axis_lines = [line for line in axis_lines if line.points]
    xs = [x for line in axis_lines for x, _ in line.points]
    ys = [y for line in axis_lines for _, y in line.points]
    if len(set(xs)) < 2 or len(set(ys)) < 2:
        return ""
    legend = _legend(axis_lines)
    top = TOP + LEGEND_ROW * len(legend)
    x_low, x_high = 0.0, max(xs) or 1.0
    y_low, y_high = min(ys), max(ys)

    def pixel(x: float, y: float) -> tuple[float, float]:
        right = (x - x_low) / (x_high - x_low)
        up = (y - y_low) / (y_high - y_low)
        return LEFT + right * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - BOTTOM - top)

    parts = _svg_start(title)
    for i, row in enumerate(legend, 1):
        parts.append(f'<text x="{LEFT}" y="{15 + LEGEND_ROW * i}">{row}</text>')
    is_y_integer = not logarithmic and _are_integers(ys)
    y_ticks = _decade_ticks(y_low, y_high) if logarithmic else _ticks(y_low, y_high, is_y_integer)
    for tick, label in zip(
        y_ticks, _tick_labels([10**t if logarithmic else t for t in y_ticks], is_y_integer), strict=True
    ):
        _, y = pixel(x_low, tick)
        parts += _grid_line(y, label)
    is_x_integer = _are_integers(xs)
    x_ticks = _ticks(x_low, x_high, is_x_integer)
    for tick, label in (ticks or dict(zip(x_ticks, _tick_labels(x_ticks, is_x_integer), strict=True))).items():
        x, _ = pixel(tick, y_low)
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 10}" text-anchor="middle">{html.escape(label)}</text>')
    for i, line in enumerate(axis_lines):
        color, (dash, _) = _color(line, i), _dash(line)
        dash_attribute = f' stroke-dasharray="{dash}"' if dash else ""
        pixels = [pixel(*point) for point in line.points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.8"{dash_attribute}/>')
        if len(pixels) <= MAX_MARKED_POINTS:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{color}"/>' for x, y in pixels]
    return "".join([*parts, "</svg>"])


def histogram(title: str, values: Sequence[float], bins: int = 24) -> str:
    """Return a histogram as SVG, with `bins` equal intervals from zero, or "" if all values are equal."""
    if len(set(values)) < 2:
        return ""
    max_value = max(values)
    counts = [0] * bins
    for value in values:
        counts[min(bins - 1, int(bins * value / max_value))] += 1
    width, height = WIDTH - LEFT - RIGHT, HEIGHT - BOTTOM - TOP
    parts = _svg_start(title)
    y_ticks = _ticks(0, max(counts), is_integer=True)
    for tick, label in zip(y_ticks, _tick_labels(y_ticks, is_integer=True), strict=True):
        parts += _grid_line(HEIGHT - BOTTOM - tick / max(counts) * height, label)
    for i, count in enumerate(counts):
        if count:
            length = count / max(counts) * height
            corner = f'x="{LEFT + i * width / bins + 1:.1f}" y="{HEIGHT - BOTTOM - length:.1f}"'
            parts.append(f'<rect {corner} width="{width / bins - 2:.1f}" height="{length:.1f}" fill="{COLORS[0]}"/>')
    x_ticks = _ticks(0, max_value)
    for tick, label in zip(x_ticks, _tick_labels(x_ticks), strict=True):
        x = LEFT + tick / max_value * width
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 10}" text-anchor="middle">{label}</text>')
    return "".join([*parts, "</svg>"])


def _svg_start(title: str) -> list[str]:
    """Return the opening tag and the title of a chart."""
    start = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">'
    return [start, f'<text x="{LEFT}" y="15" class="title">{html.escape(title)}</text>']


def _grid_line(y: float, label: str) -> list[str]:
    """Return a horizontal grid line at a tick of the y axis, and its label."""
    line = f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>'
    return [line, f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>']


def _to_axes(line: Line, logarithmic: bool) -> Line:
    """Return a line with only the points that the axes can show; on a logarithmic axis, y becomes log10(y)."""
    points = [(x, y) for x, y in line.points if math.isfinite(x) and math.isfinite(y)]
    return replace(line, points=[(x, math.log10(y)) for x, y in points if y > 0] if logarithmic else points)


def _color(line: Line, index: int) -> str:
    return line.color or COLORS[index % len(COLORS)]


def _dash(line: Line) -> tuple[str, str]:
    return DASHES[line.dash % len(DASHES)]


def _legend(lines: Sequence[Line]) -> list[str]:
    """Return the rows of a legend, which names each line in its color, or no rows for a single line."""
    rows: list[str] = []
    free_letters = 0
    for i, line in enumerate(lines if len(lines) > 1 else []):
        if not line.name:
            continue
        name = line.name + (f" ({style})" if (style := _dash(line)[1]) else "")
        if len(name) > free_letters:
            rows.append("")
            free_letters = LEGEND_LETTERS
        gap = ' dx="12"' if rows[-1] else ""
        rows[-1] += f'<tspan{gap} style="fill:{_color(line, i)}">{html.escape(name)}</tspan>'
        free_letters -= len(name) + 2
    return rows


def _are_integers(values: Sequence[float]) -> bool:
    return all(float(value).is_integer() for value in values)


def _ticks(low: float, high: float, is_integer: bool = False) -> list[float]:
    """Return three to six round numbers between low and high, or fewer if only integers are allowed."""
    min_step = max((high - low) / 4, 1.0 if is_integer else 0.0)
    power = 10 ** math.floor(math.log10(min_step))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= min_step)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _decade_ticks(low: float, high: float) -> list[float]:
    """Return the ticks of a logarithmic axis from 10^low to 10^high, as log10.

    The ticks are 1, 2, and 5 times powers of ten, or round numbers if fewer than two of these are in the range.
    """
    powers = range(math.floor(low), math.ceil(high) + 1)
    ticks = [t for p in powers for m in (1, 2, 5) if low <= (t := p + math.log10(m)) <= high]
    return ticks if len(ticks) > 1 else [math.log10(tick) for tick in _ticks(10**low, 10**high)]


def _tick_labels(values: Sequence[float], is_integer: bool = False) -> list[str]:
    """Return tick labels with enough digits to be distinct, such as 100k and 100.2k.

    Integers that are not all multiples of 100 are written in full: 8,040 instead of 8.04k.
    """
    if is_integer and any(value % 100 for value in values):
        return [f"{value:,.0f}" for value in values]
    candidates = [[_format_number(value, digits) for value in values] for digits in range(3, 10)]
    return next((labels for labels in candidates if len(set(labels)) == len(set(values))), candidates[-1])


def _format_number(value: float, digits: int) -> str:
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:.{digits}g}{suffix}"
    return f"{value:.{digits}g}"


# Cameras and points on a plane.

PLAN_WIDTH, PLAN_HEIGHT, MARGIN, TITLE = 460, 340, 18, 26  # px
LENGTH, SPREAD = 11.0, 0.45  # length of a camera's triangle, px; half of its width relative to its length
MAX_PLAN_POINTS = 1500
MAX_POINT_DISTANCE = 3.0  # of points from the center of the cameras, relative to the cameras' radius


def camera_plans(views: Mapping[str, Sequence[View]], points: NDArray[np.floating]) -> list[str]:
    """Return two SVG plans of cameras and of the points around them, [N, 3]: from above and from the side.

    views: groups of views, by name in the legend.  Each camera shows its name on hover.
    The result is empty for fewer than two cameras.
    """
    views = {name: group for name, group in views.items() if group}
    all_views = [view for group in views.values() for view in group]
    if len(all_views) < 2:
        return []
    up = up_direction(all_views)
    right = perpendicular(up)
    centers = np.stack([view.position for view in all_views])
    max_distance = MAX_POINT_DISTANCE * float(np.abs(centers - centers.mean(axis=0)).max())
    sample = points[:: max(1, len(points) // MAX_PLAN_POINTS)].astype(np.float64)
    nearby = sample[(np.abs(sample - centers.mean(axis=0)) < max(max_distance, 1e-9)).all(axis=1)]
    planes = {"cameras from above": np.cross(right, up), "cameras from the side": -up}
    return [_plan(title, views, nearby, np.stack([right, down])) for title, down in planes.items()]


def _plan(
    title: str, views: Mapping[str, Sequence[View]], points: NDArray[np.float64], axes: NDArray[np.float64]
) -> str:
    """Return a plan of points, and of cameras as triangles that open in the view direction.

    axes: the directions in the scene that point right and down in the plan, [2, 3].
    """
    centers = {name: np.stack([view.position for view in group]) @ axes.T for name, group in views.items()}
    positions = np.concatenate([points @ axes.T, *centers.values()])
    low, high = positions.min(axis=0), positions.max(axis=0)
    plot_size = np.array([PLAN_WIDTH - 2 * MARGIN, PLAN_HEIGHT - TITLE - 2 * MARGIN])
    scale = float((plot_size / np.maximum(high - low, 1e-12)).min())
    corner = np.array([MARGIN, MARGIN + TITLE]) + (plot_size - scale * (high - low)) / 2

    def pixels(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(corner + scale * (values - low))

    parts = [f'<svg viewBox="0 0 {PLAN_WIDTH} {PLAN_HEIGHT}" role="img" aria-label="{html.escape(title)}">']
    parts.append(f'<text x="{MARGIN}" y="18" class="title">{html.escape(title)}</text>')
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in pixels(points @ axes.T))
    parts.append(f'<path d="{dots}" class="dots"/>')
    for i, (name, group) in enumerate(views.items()):
        color = COLORS[i % len(COLORS)]
        parts.append(f'<g fill="{color}" fill-opacity=".75" stroke="{color}">')
        for view, center in zip(group, pixels(centers[name]), strict=True):
            triangle = _triangle(center, axes @ view.world_to_camera[2, :3])
            parts.append(f'<path d="{triangle}"><title>{html.escape(view.name)}</title></path>')
        legend = f'x="{PLAN_WIDTH - MARGIN}" y="{18 + 14 * i}" text-anchor="end" style="fill:{color}"'
        parts.append(f"</g><text {legend}>{len(group)} {html.escape(name)}</text>")
    return "".join([*parts, "</svg>"])


def _triangle(center: NDArray[np.float64], direction: NDArray[np.float64]) -> str:
    """Return the SVG path of a camera, foreshortened by its direction.  center, direction: [2]."""
    forward = LENGTH * direction
    sideways = SPREAD * LENGTH * np.array([-direction[1], direction[0]]) / (float(np.linalg.norm(direction)) or 1.0)
    (x, y), (a, b), (c, d) = center, center + forward + sideways, center + forward - sideways
    return f"M{x:.1f} {y:.1f}L{a:.1f} {b:.1f}L{c:.1f} {d:.1f}Z"
