"""Estimate the relative exposures of photographs from the pixels in which they show the same points.

For each channel, ln y = e + a, with the exposure e of a photograph and the color a of a point.  Both minimize the sum
of |ln y - e - a| exp(a), which is robust to hidden, glossy or misplaced points, and weights differences as they appear
in the image, where haze on a dark point is small.  The solver is iteratively reweighted least squares, by conjugate
gradients on sums in a fixed order.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.photos.appearance import LUMINANCE, Floats
from clsplat.photos.photographs import Mask
from clsplat.scene.scene import Tracks
from clsplat.scene.view import View, load_exposures

DARKEST, BRIGHTEST = 0.05, 0.95  # valid values; beyond them, noise and clipping dominate
SIDE = 3  # px, side of the square around a point that is averaged
GAMMA = 2.2  # of the values of images
MIN_VALUES = 20  # per photograph
ROUNDS = 10
EXACT = 0.01  # log units: smaller differences do not get larger weights
CONVERGED = 1e-6  # of the first residual
ROUNDING = 1e-9  # log units: differences that count as zero
Integers = NDArray[np.intp]
Read = Callable[[View], tuple[NDArray[np.uint8], Mask | None]]


@dataclass(frozen=True)
class Exposures:
    """Log gains of red, green and blue, [3], by the name of a view; their mean is 0."""

    log_gains: dict[str, Floats]
    source: str  # in words
    explained: float = 1.0  # share of the differences between photographs of one point that the gains remove

    @property
    def spread(self) -> float:
        """The standard deviation of log exposures; 0 if none is known."""
        return float(np.std([LUMINANCE @ gains for gains in self.log_gains.values()])) if self.log_gains else 0.0

    @property
    def text(self) -> str:
        """A summary in words."""
        if not self.log_gains:
            return self.source
        return f"exposures of {len(self.log_gains)} photographs differ by {self.spread:.1%} {self.source}"


UNKNOWN = Exposures({}, "exposures are unknown, from tracks as well as from EXIF")


def noted(views: Sequence[View]) -> Exposures:
    """Return exposures from EXIF: EV = log2(t ISO / N²), with a gamma of 2.2.

    Real tone curves differ, so this is only an initial value.
    """
    values = {view.name: known.value for view, known in zip(views, load_exposures(views), strict=True) if known}
    if not values:
        return UNKNOWN
    mean = math.fsum(values.values()) / len(values)
    gains = {name: np.full(3, math.log(2) * (value - mean) / GAMMA) for name, value in values.items()}
    return Exposures(gains, "by EXIF")


def with_noted(shown: Exposures, noted: Exposures) -> Exposures:
    """Complete exposures measured on tracks by those from EXIF.

    Those from EXIF are shifted by the mean difference over the photographs that have both; if there are none, they are
    not used.
    """
    if not shown.log_gains:
        return noted
    both, more = ([name for name in noted.log_gains if (name in shown.log_gains) is known] for known in (True, False))
    if not both or not more:
        return shown
    apart = np.mean([shown.log_gains[name] - noted.log_gains[name] for name in both], axis=0)
    found = {**shown.log_gains, **{name: noted.log_gains[name] + apart for name in more}}
    mean = np.mean(list(found.values()), axis=0)
    source = f"{shown.source}, those of {len(more)} {noted.source}"
    return Exposures({name: gains - mean for name, gains in found.items()}, source, shown.explained)


def measured(tracks: Tracks, views: Iterable[View], read: Read) -> Exposures:
    """Measure the exposures of photographs on tracks; views of a name that was seen before are skipped.

    read: returns the photograph of a view, [height, width, 3], and its mask.
    """
    by_name: dict[str, View] = {}
    for view in views:
        by_name.setdefault(view.name, view)
    per_view = [samples(tracks, view, *read(view)) for view in by_name.values()]
    photograph = np.repeat(np.arange(len(per_view)), [len(rows) for rows, _ in per_view])
    point, values = (np.concatenate([part[i] for part in per_view]) for i in (0, 1))
    log_gains, shared, left = np.full((len(per_view), 3), np.nan), 0, np.zeros(2)
    for channel in range(3):
        usable = (values[:, channel] > DARKEST) & (values[:, channel] < BRIGHTEST)
        photographs = np.bincount(point[usable], minlength=len(tracks.positions))
        usable &= photographs[point] > 1
        shared = max(shared, int(np.count_nonzero(photographs > 1)))
        parts = photograph[usable], point[usable], values[usable, channel], len(per_view)
        log_gains[:, channel], with_gains = _fitted(*parts)
        left += with_gains, _fitted(*parts, rounds=0)[1]
    known = np.isfinite(log_gains).all(axis=1)
    log_gains -= log_gains[known].mean(axis=0) if known.any() else 0
    explained = float(1 - left[0] / left[1]) if left[1] > 0 else 0.0
    source = f"at {shared:,} points, which is {explained:.0%} of what differs between photographs of one point"
    return Exposures({name: log_gains[i] for i, name in enumerate(by_name) if known[i]}, source, explained)


def samples(tracks: Tracks, view: View, image: NDArray[np.uint8], mask: Mask | None) -> tuple[Integers, Floats]:
    """Return the points in a photograph, rows [S], and their colors there, [S, 3] in [0, 1]."""
    rows = tracks.seen.get(view.name, np.empty(0, np.int64))
    camera, (height, width) = view.camera, image.shape[:2]
    turned = np.einsum("ij,nj->in", view.world_to_camera[:, :3], tracks.positions[rows])  # no sum depends on threads
    x, y, z = turned + view.world_to_camera[:, 3:]
    in_front = z > 0
    depth = np.where(in_front, z, 1)
    xy = [camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy]
    inside = in_front & (xy[0] >= 0) & (xy[0] < width) & (xy[1] >= 0) & (xy[1] < height)
    column, row = (np.floor(np.where(inside, value, 0)).astype(np.intp) for value in xy)
    if mask is not None:
        inside &= mask[row, column]
    sums = cv2.boxFilter(image, cv2.CV_32S, (SIDE, SIDE), normalize=False)
    return rows[inside], sums[row[inside], column[inside]] / (255.0 * SIDE**2)


def _fitted(
    photograph: Integers, point: Integers, values: Floats, count: int, rounds: int = ROUNDS
) -> tuple[Floats, float]:
    """Return the exposures of photographs, [count], NaN for one with too few values, and the sum of residuals.

    rounds: 0 to keep all exposures equal.
    """
    exposures, logarithms, weights = np.zeros(count), np.log(values), np.ones(len(values))
    left = np.zeros(len(values))
    for number in range(ROUNDS):
        if number < rounds:
            exposures += _corrections(photograph, point, logarithms - exposures[photograph], weights, count)
        of_points = _means(point, logarithms - exposures[photograph], weights)[point]
        left = np.abs(logarithms - exposures[photograph] - of_points)
        weights = np.exp(of_points) / np.maximum(left, EXACT)
    few = np.bincount(photograph, minlength=count) < MIN_VALUES
    return np.where(few, np.nan, exposures), float(left.sum())


def _corrections(photograph: Integers, point: Integers, rest: Floats, weights: Floats, count: int) -> Floats:
    """Return the exposures, [count], that fit `rest` best with a color per point, by conjugate gradients."""

    def gathered(values: Floats) -> Floats:
        left = weights * (values - _means(point, values, weights)[point])
        return np.bincount(photograph, left, minlength=count).astype(np.float64)

    solution, residual = np.zeros(count), gathered(rest)
    direction, square = residual.copy(), float((residual**2).sum())
    of_rounding = ROUNDING * np.bincount(photograph, weights, minlength=count)
    goal = max(CONVERGED**2 * square, float((of_rounding**2).sum()))
    for _ in range(count):
        if square <= goal:
            break
        image = gathered(direction[photograph])
        step = square / float((direction * image).sum())
        solution, residual = solution + step * direction, residual - step * image
        before, square = square, float((residual**2).sum())
        direction = residual + square / before * direction
    return solution


def _means(group: Integers, values: Floats, weights: Floats) -> Floats:
    """Return weighted means of groups; 0 for an empty one."""
    sums = np.bincount(group, weights)
    return np.bincount(group, weights * values) / np.where(sums > 0, sums, 1)
