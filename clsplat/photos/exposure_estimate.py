"""Estimate the relative exposures of photographs from pixels that show the same points.

For each channel, ln y = e + a, with the exposure e of a photograph and the color a of a point.  They minimize the sum
of |ln y - e - a| exp(a), which is robust to hidden, glossy, or misplaced points, and weights differences by their size
in the image, where haze on a dark point is small.  The solver is iteratively reweighted least squares, with conjugate
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

DARKEST, BRIGHTEST = 0.05, 0.95  # bounds of valid values; beyond them, noise and clipping dominate
SIDE = 3  # px, side of the square around a point that is averaged
GAMMA = 2.2  # of image values
MIN_VALUES = 20  # per photograph and channel
ROUNDS = 10  # of reweighting
EXACT = 0.01  # log units: smaller differences do not get larger weights
TOLERANCE = 1e-6  # relative to the first residual
ROUNDING = 1e-9  # log units: differences that count as zero
Integers = NDArray[np.intp]
Read = Callable[[View], tuple[NDArray[np.uint8], Mask | None]]


@dataclass(frozen=True)
class Exposures:
    """Log gains of red, green, and blue, [3], by view name; their mean is 0."""

    log_gains: dict[str, Floats]
    source: str  # in words
    explained_variance: float = 1.0  # fraction of the differences between photographs of a point that gains remove

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


UNKNOWN = Exposures({}, "neither tracks nor EXIF give exposures")


def exif_exposures(views: Sequence[View]) -> Exposures:
    """Return exposures from EXIF, EV = log2(t ISO / N²), with a gamma of 2.2.

    Real tone curves differ, so this is only an initial value.
    """
    values = {view.name: exif.value for view, exif in zip(views, load_exposures(views), strict=True) if exif}
    if not values:
        return UNKNOWN
    mean = math.fsum(values.values()) / len(values)
    gains = {name: np.full(3, math.log(2) * (value - mean) / GAMMA) for name, value in values.items()}
    return Exposures(gains, "by EXIF")


def complete_exposures(measured: Exposures, exif: Exposures) -> Exposures:
    """Add exposures from EXIF for photographs without exposures measured on tracks.

    Exposures from EXIF are shifted by the mean difference over the photographs that have both; without such
    photographs, they are not used.
    """
    if not measured.log_gains:
        return exif
    shared, new = ([name for name in exif.log_gains if (name in measured.log_gains) is flag] for flag in (True, False))
    if not shared or not new:
        return measured
    offset = np.mean([measured.log_gains[name] - exif.log_gains[name] for name in shared], axis=0)
    combined = {**measured.log_gains, **{name: exif.log_gains[name] + offset for name in new}}
    mean = np.mean(list(combined.values()), axis=0)
    source = f"{measured.source}, those of {len(new)} {exif.source}"
    return Exposures({name: gains - mean for name, gains in combined.items()}, source, measured.explained_variance)


def measure_exposures(tracks: Tracks, views: Iterable[View], read: Read) -> Exposures:
    """Measure the exposures of photographs on tracks; of views with the same name, only the first is used.

    read: returns the photograph of a view, [height, width, 3], and its mask.
    """
    by_name: dict[str, View] = {}
    for view in views:
        by_name.setdefault(view.name, view)
    per_view = [sample_points(tracks, view, *read(view)) for view in by_name.values()]
    photograph = np.repeat(np.arange(len(per_view)), [len(rows) for rows, _ in per_view])
    point, values = (np.concatenate([part[i] for part in per_view]) for i in (0, 1))
    log_gains, shared, residuals = np.full((len(per_view), 3), np.nan), 0, np.zeros(2)
    for channel in range(3):
        usable = (values[:, channel] > DARKEST) & (values[:, channel] < BRIGHTEST)
        photographs = np.bincount(point[usable], minlength=len(tracks.positions))
        usable &= photographs[point] > 1
        shared = max(shared, int(np.count_nonzero(photographs > 1)))
        arguments = photograph[usable], point[usable], values[usable, channel], len(per_view)
        log_gains[:, channel], with_gains = _fit(*arguments)
        residuals += with_gains, _fit(*arguments, rounds=0)[1]
    is_known = np.isfinite(log_gains).all(axis=1)
    log_gains -= log_gains[is_known].mean(axis=0) if is_known.any() else 0
    fraction = float(1 - residuals[0] / residuals[1]) if residuals[1] > 0 else 0.0
    source = f"at {shared:,} points, which explains {fraction:.0%} of the variance between photographs of a point"
    return Exposures({name: log_gains[i] for i, name in enumerate(by_name) if is_known[i]}, source, fraction)


def sample_points(tracks: Tracks, view: View, image: NDArray[np.uint8], mask: Mask | None) -> tuple[Integers, Floats]:
    """Return the rows of the points that a photograph shows, [S], and their colors there, [S, 3] in [0, 1]."""
    rows = tracks.rows.get(view.name, np.empty(0, np.int64))
    camera, (height, width) = view.camera, image.shape[:2]
    rotated = np.einsum("ij,nj->in", view.world_to_camera[:, :3], tracks.positions[rows])  # independent of threads
    x, y, z = rotated + view.world_to_camera[:, 3:]
    in_front = z > 0
    depth = np.where(in_front, z, 1)
    xy = [camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy]
    inside = in_front & (xy[0] >= 0) & (xy[0] < width) & (xy[1] >= 0) & (xy[1] < height)
    column, row = (np.floor(np.where(inside, value, 0)).astype(np.intp) for value in xy)
    if mask is not None:
        inside &= mask[row, column]
    sums = cv2.boxFilter(image, cv2.CV_32S, (SIDE, SIDE), normalize=False)
    return rows[inside], sums[row[inside], column[inside]] / (255.0 * SIDE**2)


def _fit(
    photograph: Integers, point: Integers, values: Floats, count: int, rounds: int = ROUNDS
) -> tuple[Floats, float]:
    """Return the exposures of photographs, [count], NaN where there are too few values, and the sum of residuals.

    rounds: 0 keeps all exposures equal.
    """
    exposures, logarithms, weights = np.zeros(count), np.log(values), np.ones(len(values))
    residuals = np.zeros(len(values))
    for number in range(ROUNDS):
        if number < rounds:
            exposures += _corrections(photograph, point, logarithms - exposures[photograph], weights, count)
        colors = _means(point, logarithms - exposures[photograph], weights)[point]
        residuals = np.abs(logarithms - exposures[photograph] - colors)
        weights = np.exp(colors) / np.maximum(residuals, EXACT)
    has_too_few = np.bincount(photograph, minlength=count) < MIN_VALUES
    return np.where(has_too_few, np.nan, exposures), float(residuals.sum())


def _corrections(photograph: Integers, point: Integers, target: Floats, weights: Floats, count: int) -> Floats:
    """Return the exposures, [count], that fit `target` best with a color per point, by conjugate gradients."""

    def apply(values: Floats) -> Floats:
        differences = weights * (values - _means(point, values, weights)[point])
        return np.bincount(photograph, differences, minlength=count).astype(np.float64)

    solution, residual = np.zeros(count), apply(target)
    direction, squared_norm = residual.copy(), float((residual**2).sum())
    rounding = ROUNDING * np.bincount(photograph, weights, minlength=count)
    goal = max(TOLERANCE**2 * squared_norm, float((rounding**2).sum()))
    for _ in range(count):
        if squared_norm <= goal:
            break
        product = apply(direction[photograph])
        step = squared_norm / float((direction * product).sum())
        solution, residual = solution + step * direction, residual - step * product
        previous, squared_norm = squared_norm, float((residual**2).sum())
        direction = residual + squared_norm / previous * direction
    return solution


def _means(group: Integers, values: Floats, weights: Floats) -> Floats:
    """Return the weighted means of groups; 0 for empty groups."""
    sums = np.bincount(group, weights)
    return np.bincount(group, weights * values) / np.where(sums > 0, sums, 1)
