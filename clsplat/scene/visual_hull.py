"""Create points from photographs with transparency: the visual hull of their silhouettes (Laurentini 1994).

A box is split into cells, as an octree (Szeliski 1993).  A cell outside the silhouette in at least one view is empty,
and a cell inside all silhouettes is full; the others are split.  Cells of the last level are full if their centers are
inside all silhouettes.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.scene.scene import PointCloud
from clsplat.scene.view import View

Floats = NDArray[np.floating]
Bools = NDArray[np.bool_]
Cells = NDArray[np.integer]  # [M, 3], indices in a grid
LONG_SIDE = 400  # px, long side of the downscaled photographs
MAX_VIEWS = 64  # largest number of views that are used as silhouettes
MIN_RESOLUTION, MAX_RESOLUTION = 16, 256  # cells per side of the box
HALF, OPAQUE = 127, 250  # alpha above which a pixel is in the silhouette, and from which its color is used
MIN_VIEWS, MIN_FRACTION = 2, 0.25  # smallest number and fraction of views that must see a cell
HALF_DIAGONAL = 0.75**0.5  # half the diagonal of a cube of side 1
MAX_BEHIND = 2.0  # largest distance of a visible point behind the nearest point of its pixel, in cell sides


@dataclass(frozen=True)
class Silhouette:
    """A photograph with transparency, and its camera."""

    view: View
    rgba: NDArray[np.uint8]  # [H, W, 4]

    @property
    def alpha(self) -> NDArray[np.uint8]:
        """The alpha channel, [H, W]."""
        return np.ascontiguousarray(self.rgba[:, :, 3])

    def project(self, points: NDArray[np.float32]) -> "Projection":
        """Project points, [M, 3], into the image."""
        c, pose = self.view.camera, self.view.world_to_camera
        matrix = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) @ pose).astype(np.float32)
        # no matrix product: BLAS sums in an order that depends on the number of threads
        x, y, depth = (sum(row[k] * points[:, k] for k in range(3)) + row[3] for row in matrix)
        is_in_front = depth > 0
        safe_depth = np.where(is_in_front, depth, 1)
        row = np.floor(y / safe_depth).clip(-1, c.height).astype(int)
        column = np.floor(x / safe_depth).clip(-1, c.width).astype(int)
        is_inside = is_in_front & (row >= 0) & (row < c.height) & (column >= 0) & (column < c.width)
        return Projection(is_inside, row[is_inside], column[is_inside], depth[is_inside])

    def radius(self, size: float, depth: Floats) -> int:
        """Return an upper bound, px, of the projected radius of balls of radius `size` at the depths `depth`."""
        c = self.view.camera
        slant = math.hypot(1, max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy)
        return min(math.ceil(slant * size * max(c.fx, c.fy) / float(depth.min())), max(c.width, c.height))


@dataclass(frozen=True)
class Projection:
    """The projections of M points, of which K are in the image."""

    is_inside: Bools  # [M]
    row: NDArray[np.integer]  # [K] px
    column: NDArray[np.integer]  # [K] px
    depth: Floats  # [K] scene units


def hull_points(
    views: Sequence[View],
    center: Floats,
    half_side: float,
    load: Callable[[View], NDArray[np.uint8] | None],
    count: int,
    seed: int,
) -> PointCloud:
    """Return at most `count` colored points on the hull, in a box of side 2 `half_side` around `center`, [3].

    load: returns a photograph with its alpha, [H, W, 4], or None without transparency.  Cells are split until about
    `count` of them are on the surface, or until MAX_RESOLUTION of them are along each side of the box.
    """
    silhouettes = list(_load_silhouettes(views, load))
    is_full, resolution = np.zeros((MIN_RESOLUTION,) * 3, bool), MIN_RESOLUTION
    cells: Cells = np.argwhere(~is_full)
    while True:
        centers, side = _cell_centers(cells, center, half_side, resolution)
        is_inside, is_cut = _classify(silhouettes, centers, HALF_DIAGONAL * side)
        is_full[tuple(cells[is_inside].T)] = True
        cells, resolution = _split(cells[is_cut]), 2 * resolution
        is_full = is_full.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        if is_cut.sum() >= count or resolution == MAX_RESOLUTION:
            break
    is_inside, _ = _classify(silhouettes, _cell_centers(cells, center, half_side, resolution)[0], 0)
    is_full[tuple(cells[is_inside].T)] = True
    points, side = _cell_centers(
        np.argwhere(is_full & ~scipy.ndimage.binary_erosion(is_full, border_value=1)), center, half_side, resolution
    )
    colors, is_visible = _mean_colors(silhouettes, points, side)
    points, colors = points[is_visible], colors[is_visible]
    sampled_rows = np.sort(np.random.default_rng([seed, count]).permutation(len(points))[:count])
    return PointCloud(points[sampled_rows], colors[sampled_rows])


def _load_silhouettes(views: Sequence[View], load: Callable[[View], NDArray[np.uint8] | None]) -> Iterator[Silhouette]:
    for index in np.unique(np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)):
        view = views[index]
        small_view = view.resized(view.downscale * max(1.0, max(view.camera.width, view.camera.height) / LONG_SIDE))
        rgba = load(small_view)
        if rgba is not None:
            yield Silhouette(small_view, rgba)


def _split(cells: Cells) -> Cells:
    """Return the eight children of each cell, [8 M, 3]."""
    return (2 * cells[:, None] + np.indices((2, 2, 2)).reshape(3, -1).T).reshape(-1, 3)


def _cell_centers(cells: Cells, center: Floats, half_side: float, resolution: int) -> tuple[NDArray[np.float32], float]:
    """Return the centers, [M, 3], and the side of cells in a box with `resolution` cells along each side."""
    side = 2 * half_side / resolution
    return (center - half_side + side * (cells + 0.5)).astype(np.float32), side


def _classify(silhouettes: Sequence[Silhouette], centers: NDArray[np.float32], radius: float) -> tuple[Bools, Bools]:
    """Return two masks, [M]: balls inside all silhouettes, and balls on the edge of some but outside of none.

    Only views in which a ball is visible count.  Balls visible in too few views are in neither mask.
    """
    is_full, remaining, view_counts = np.ones(len(centers), bool), np.arange(len(centers)), np.zeros(len(centers), int)
    for silhouette in silhouettes:
        projection = silhouette.project(centers[remaining])
        if not len(projection.depth):
            continue
        kernel = np.ones((2 * silhouette.radius(radius, projection.depth) + 1,) * 2, np.uint8)
        rows = remaining[projection.is_inside]
        view_counts[rows] += 1
        is_full[rows[cv2.erode(silhouette.alpha, kernel)[projection.row, projection.column] <= HALF]] = False
        is_left = ~projection.is_inside
        is_left[projection.is_inside] = cv2.dilate(silhouette.alpha, kernel)[projection.row, projection.column] > HALF
        remaining = remaining[is_left]
    is_candidate = np.zeros(len(centers), bool)
    is_candidate[remaining] = True
    is_candidate &= view_counts >= max(MIN_VIEWS, MIN_FRACTION * len(silhouettes))
    return is_candidate & is_full, is_candidate & ~is_full


def _mean_colors(
    silhouettes: Sequence[Silhouette], points: NDArray[np.float32], side: float
) -> tuple[NDArray[np.float32], Bools]:
    """Return the mean colors of points in the views that show them, [M, 3] in [0, 1], and a visibility mask, [M]."""
    sums, counts = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
    for silhouette in silhouettes:
        projection, camera = silhouette.project(points), silhouette.view.camera
        if not len(projection.depth):
            continue
        cell = max(1, math.ceil(side * max(camera.fx, camera.fy) / float(np.median(projection.depth))))  # px
        nearest = np.full((camera.height // cell + 1, camera.width // cell + 1), np.inf, np.float32)
        np.minimum.at(nearest, (projection.row // cell, projection.column // cell), projection.depth)
        is_visible = projection.depth <= nearest[projection.row // cell, projection.column // cell] + MAX_BEHIND * side
        rgba = silhouette.rgba[projection.row, projection.column]
        is_visible &= rgba[:, 3] >= OPAQUE
        rows = np.flatnonzero(projection.is_inside)[is_visible]
        sums[rows] += rgba[is_visible, :3]
        counts[rows] += 1
    return np.asarray(sums / np.maximum(255 * counts, 1)[:, None], np.float32), counts > 0
