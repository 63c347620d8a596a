"""Estimate the relative exposures of photographs from pixels that show the same points.

For each channel, a pixel value y is modeled as ln y = e + a, where e is the log exposure of the photograph and a is the
log color of the point.  The estimate minimizes the sum of |ln y - e - a| exp(a), which is robust to hidden, glossy, or
misplaced points.  The factor exp(a) converts log differences to pixel differences, so haze on a dark point counts
little.
The solver is iteratively reweighted least squares with conjugate gradients.  All sums have a fixed order.
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
MIN_VALUES = 20  # valid values that a photograph needs in each channel
ROUNDS = 10  # rounds of reweighting
EXACT = 0.01  # log units: smaller differences do not get larger weights
TOLERANCE = 1e-6  # relative to the first residual
ROUNDING = 1e-9  # log units: differences that count as zero
Integers = NDArray[np.intp]
PhotographReader = Callable[[View], tuple[NDArray[np.uint8], Mask | None]]


@dataclass(frozen=True)
class Exposures:
    """The exposures of photographs relative to their mean, as logarithms of color gains."""

    log_gains: dict[str, Floats]  # of red, green, and blue, [3], by view name; their mean over the views is 0
    source: str  # for messages
    explained_variance: float = 1.0  # fraction of the differences between photographs of a point that the gains remove

    @property
    def spread(self) -> float:
        """The standard deviation of the log exposures; 0 if no exposure is known."""
        return float(np.std([LUMINANCE @ gains for gains in self.log_gains.values()])) if self.log_gains else 0.0

    @property
    def summary(self) -> str:
        """The number, spread, and source of the exposures as text, for messages."""
        if not self.log_gains:
            return self.source
        return f"exposures of {len(self.log_gains)} photos differ by {self.spread:.1%} {self.source}"


UNKNOWN = Exposures({}, "neither tracks nor EXIF gives exposures")


def exposures_from_exif(views: Sequence[View]) -> Exposures:
    """Compute exposures from EXIF data as log2(t ISO / N²), for image values with a gamma of 2.2.

    t is the exposure time in seconds, and N is the f-number.  Real tone curves differ, so the result is only an initial
    value.
    """
    values = {view.name: exif.value for view, exif in zip(views, load_exposures(views), strict=True) if exif}
    if not values:
        return UNKNOWN
    mean = math.fsum(values.values()) / len(values)
    gains = {name: np.full(3, math.log(2) * (value - mean) / GAMMA) for name, value in values.items()}
    return Exposures(gains, "according to EXIF")


def complete_exposures(base: Exposures, exif: Exposures) -> Exposures:
    """Add exposures from EXIF for photographs without exposures measured on tracks.

    Exposures from EXIF are shifted by the mean difference over the photographs that have both kinds.  If no photograph
    has both, exposures from EXIF are not used.
    """
    if not base.log_gains:
        return exif
    shared_names = [name for name in exif.log_gains if name in base.log_gains]
    new_names = [name for name in exif.log_gains if name not in base.log_gains]
    if not shared_names or not new_names:
        return base
    offset = np.mean([base.log_gains[name] - exif.log_gains[name] for name in shared_names], axis=0)
    log_gains = {**base.log_gains, **{name: exif.log_gains[name] + offset for name in new_names}}
    mean = np.mean(list(log_gains.values()), axis=0)
    source = f"{base.source}, those of {len(new_names)} {exif.source}"
    return Exposures({name: gains - mean for name, gains in log_gains.items()}, source, base.explained_variance)


def measure_exposures(tracks: Tracks, views: Iterable[View], read: PhotographReader) -> Exposures:
    """Measure the exposures of photographs at the points of tracks.

    Of several views with the same name, only the first is used.

    read: a function that returns the photograph of a view, [height, width, 3], and its mask.
    """
    by_name: dict[str, View] = {}
    for view in views:
        by_name.setdefault(view.name, view)
    samples = [sample_points(tracks, view, *read(view)) for view in by_name.values()]
    photograph = np.repeat(np.arange(len(samples)), [len(rows) for rows, _ in samples])
    point, values = (np.concatenate([sample[i] for sample in samples]) for i in (0, 1))
    log_gains, shared_count, residuals = np.full((len(samples), 3), np.nan), 0, np.zeros(2)
    for channel in range(3):
        is_usable = (values[:, channel] > DARKEST) & (values[:, channel] < BRIGHTEST)
        photograph_counts = np.bincount(point[is_usable], minlength=len(tracks.positions))
        is_usable &= photograph_counts[point] > 1
        shared_count = max(shared_count, int(np.count_nonzero(photograph_counts > 1)))
        arguments = photograph[is_usable], point[is_usable], values[is_usable, channel], len(samples)
        log_gains[:, channel], residual = _fit(*arguments)
        residuals += residual, _fit(*arguments, rounds=0)[1]
    is_known = np.isfinite(log_gains).all(axis=1)
    log_gains -= log_gains[is_known].mean(axis=0) if is_known.any() else 0
    fraction = float(1 - residuals[0] / residuals[1]) if residuals[1] > 0 else 0.0
    source = f"at {shared_count:,} points and explain {fraction:.0%} of the color differences at these points"
    return Exposures({name: log_gains[i] for i, name in enumerate(by_name) if is_known[i]}, source, fraction)


def sample_points(tracks: Tracks, view: View, image: NDArray[np.uint8], mask: Mask | None) -> tuple[Integers, Floats]:
    """Return the rows of the points that a photograph shows, [S], and their colors in it, [S, 3] in [0, 1]."""
    rows = tracks.rows.get(view.name, np.empty(0, np.int64))
    camera, (height, width) = view.camera, image.shape[:2]
    points = np.einsum("ij,nj->in", view.world_to_camera[:, :3], tracks.positions[rows])  # independent of threads
    x, y, z = points + view.world_to_camera[:, 3:]
    in_front = z > 0
    depth = np.where(in_front, z, 1)
    xy = [camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy]
    is_inside = in_front & (xy[0] >= 0) & (xy[0] < width) & (xy[1] >= 0) & (xy[1] < height)
    column, row = (np.floor(np.where(is_inside, value, 0)).astype(np.intp) for value in xy)
    if mask is not None:
        is_inside &= mask[row, column]
    sums = cv2.boxFilter(image, cv2.CV_32S, (SIDE, SIDE), normalize=False)
    return rows[is_inside], sums[row[is_inside], column[is_inside]] / (255.0 * SIDE**2)


def _fit(
    photograph: Integers, point: Integers, values: Floats, count: int, rounds: int = ROUNDS
) -> tuple[Floats, float]:
    """Return the exposures of photographs, [count], and the sum of the residuals.

    An exposure is NaN if its photograph has too few values.  rounds: number of updates; 0 keeps all exposures equal.
    """
    exposures, logarithms, weights = np.zeros(count), np.log(values), np.ones(len(values))
    residuals = np.zeros(len(values))
    for round_index in range(ROUNDS):
        if round_index < rounds:
            exposures += _solve_corrections(photograph, point, logarithms - exposures[photograph], weights, count)
        colors = _means(point, logarithms - exposures[photograph], weights)[point]
        residuals = np.abs(logarithms - exposures[photograph] - colors)
        weights = np.exp(colors) / np.maximum(residuals, EXACT)
    has_too_few = np.bincount(photograph, minlength=count) < MIN_VALUES
    return np.where(has_too_few, np.nan, exposures), float(residuals.sum())


def _solve_corrections(photograph: Integers, point: Integers, target: Floats, weights: Floats, count: int) -> Floats:
    """Return the exposures, [count], that fit `target` best with one color per point, found by conjugate gradients."""

    def apply(values: Floats) -> Floats:
        differences = weights * (values - _means(point, values, weights)[point])
        return np.bincount(photograph, differences, minlength=count).astype(np.float64)

    solution, residual = np.zeros(count), apply(target)
    direction, squared_norm = residual.copy(), float((residual**2).sum())
    rounding = ROUNDING * np.bincount(photograph, weights, minlength=count)
    tolerance = max(TOLERANCE**2 * squared_norm, float((rounding**2).sum()))
    for _ in range(count):
        if squared_norm <= tolerance:
            break
        product = apply(direction[photograph])
        step = squared_norm / float((direction * product).sum())
        solution, residual = solution + step * direction, residual - step * product
        previous_norm, squared_norm = squared_norm, float((residual**2).sum())
        direction = residual + squared_norm / previous_norm * direction
    return solution


def _means(group: Integers, values: Floats, weights: Floats) -> Floats:
    """Return the weighted means of groups; 0 for empty groups."""
    sums = np.bincount(group, weights)
    return np.bincount(group, weights * values) / np.where(sums > 0, sums, 1)
