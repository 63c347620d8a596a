"""Cameras and points on a plane, as inline SVG."""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.pages.svg import COLOURS

WIDTH, HEIGHT, MARGIN, TITLE = 460, 340, 18, 26  # px
LENGTH, SPREAD = 11.0, 0.45  # of a camera's triangle, px, and half of its opening by its length


@dataclass(frozen=True)
class Marks:
    """Cameras of one kind."""

    name: str
    centres: NDArray[np.float64]  # [M, 2], scene units
    directions: NDArray[np.float64]  # [M, 2]


def plan(title: str, marks: Sequence[Marks], points: NDArray[np.float64]) -> str:
    """Draw points [N, 2], and each camera as a triangle that opens where it looks.  Both axes have one scale."""
    everything = np.concatenate([points, *(one.centres for one in marks)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = np.array([WIDTH - 2 * MARGIN, HEIGHT - TITLE - 2 * MARGIN])
    scale = float((room / np.maximum(high - low, 1e-12)).min())
    corner = np.array([MARGIN, MARGIN + TITLE]) + (room - scale * (high - low)) / 2

    def placed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(corner + scale * (values - low))

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">']
    parts.append(f'<text x="{MARGIN}" y="18" class="title">{html.escape(title)}</text>')
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in placed(points))
    parts.append(f'<path d="{dots}" class="dots"/>')
    for i, one in enumerate(marks):
        colour = COLOURS[i % len(COLOURS)]
        shapes = "".join(map(_triangle, placed(one.centres), one.directions))
        parts.append(f'<path d="{shapes}" fill="{colour}" fill-opacity=".75" stroke="{colour}"/>')
        name = f"{len(one.centres)} {one.name}"
        parts.append(
            f'<text x="{WIDTH - MARGIN}" y="{18 + 14 * i}" text-anchor="end" style="fill:{colour}">'
            f"{html.escape(name)}</text>"
        )
    return "".join([*parts, "</svg>"])


def _triangle(at: NDArray[np.float64], direction: NDArray[np.float64]) -> str:
    """A path; shorter for a camera that looks up or down."""
    ahead = LENGTH * direction
    aside = SPREAD * LENGTH * np.array([-direction[1], direction[0]]) / (float(np.linalg.norm(direction)) or 1.0)
    (x, y), (a, b), (c, d) = at, at + ahead + aside, at + ahead - aside
    return f"M{x:.1f} {y:.1f}L{a:.1f} {b:.1f}L{c:.1f} {d:.1f}Z"
