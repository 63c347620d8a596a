"""Create points from the photographs of a scene by a plane sweep (Collins 1996).

For every photograph and each of PLANES depths, adjacent photographs are projected onto the plane at that depth.  The
surface is at the depth where they agree best.  A pixel becomes a point if adjacent photographs have the same depth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import PointCloud
from clsplat.scene.view import View

Floats = NDArray[np.floating]
Indices = NDArray[np.integer]
LONG_SIDE = 160  # px, long side of the compared photographs
PLANES = 64  # evenly spaced in inverse depth
MIN_DEPTH, MAX_DEPTH = 0.1, 20.0  # times the distance to the point that the cameras look at
NEIGHBORS = 4  # photographs with which each photograph is compared
WINDOW = 5  # px, side of the square over which colors are compared
MAX_COST_RATIO = 0.6  # largest accepted ratio of the cost of the best plane to the mean cost of all planes
MIN_VOTES = 2  # adjacent photographs that must confirm the depth of a point
MAX_DIFFERENCE = 1.5  # largest difference between depths that agree, in planes


@dataclass(frozen=True)
class Surface:
    """The surface in a downscaled photograph.  Its depth is known where adjacent photographs agree on it."""

    view: View
    image: Floats  # [H, W, 3] float32, in [0, 1]
    inverse_depths: Floats  # [H, W], 1 / scene units; 0 where unknown
    step: float  # difference of inverse depth between planes, 1 / scene units

    def is_new(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask, [H, W], of the pixels with a surface that none of the points, [M, 3], covers or hides.

        A point covers the pixel that it projects to, unless the surface in that pixel is more than one plane nearer.
        """
        is_visible, row, column, depth = _project(self.view, points)
        nearest = np.zeros(self.inverse_depths.shape)
        np.maximum.at(nearest, (row[is_visible], column[is_visible]), 1 / depth[is_visible])
        return np.asarray((nearest == 0) | (self.inverse_depths > nearest + self.step))


def sweep_points(
    views: Sequence[View],
    center: Floats,
    load: Callable[[View], NDArray[np.uint8]],
    count: int,
    seed: int,
    points: Floats | None = None,
    load_mask: Callable[[View], NDArray[np.bool_] | None] = lambda view: None,
) -> PointCloud:
    """Return at most `count` colored points on the surfaces that adjacent views agree on; there may be none.

    center: the point that the cameras look at, [3].  load: returns the photograph of a view, [H, W, 3].  points:
    existing points, [M, 3]; the pixels that show them are skipped.  load_mask: returns a mask, [H, W], of the pixels of
    a view that may become points, or None for all.
    """
    positions, colors = [], []
    for surface in find_surfaces(views, center, load):
        view, image, mask = surface.view, surface.image, surface.inverse_depths > 0
        if (view_mask := load_mask(view)) is not None:
            mask &= view_mask
        if points is not None:
            mask &= surface.is_new(points)
        rows, columns = np.nonzero(mask)
        positions.append(_unproject(view, rows, columns, 1 / surface.inverse_depths[mask]))
        colors.append(image[mask])
    all_positions, all_colors = np.concatenate(positions), np.concatenate(colors)
    sampled_rows = np.sort(np.random.default_rng([seed, count]).permutation(len(all_positions))[:count])
    return PointCloud(all_positions[sampled_rows].astype(np.float32), all_colors[sampled_rows])


def find_surfaces(views: Sequence[View], center: Floats, load: Callable[[View], NDArray[np.uint8]]) -> list[Surface]:
    """Return the surface in each view; the arguments are those of `sweep_points`."""
    views = [
        view.resized(view.downscale * max(1.0, max(view.camera.width, view.camera.height) / LONG_SIDE))
        for view in views
    ]
    images = [load(view).astype(np.float32) / 255 for view in views]
    neighbors = [_neighbors(i, views) for i in range(len(views))]
    distance = float(np.median([np.linalg.norm(view.position - center) for view in views]))
    inverse_depths = np.linspace(1 / (MAX_DEPTH * distance), 1 / (MIN_DEPTH * distance), PLANES)
    planes = [_best_planes(i, views, images, neighbors[i], inverse_depths) for i in range(len(views))]
    masks = [_confirm(i, views, planes, neighbors[i], inverse_depths) for i in range(len(views))]
    step = float(inverse_depths[1] - inverse_depths[0])
    return [
        Surface(view, images[i], np.where(masks[i], inverse_depths[planes[i]], 0), step) for i, view in enumerate(views)
    ]


def _neighbors(i: int, views: Sequence[View]) -> list[int]:
    """Return the indices of the NEIGHBORS nearest views of view i that look within 60° of its direction."""
    position, direction = views[i].position, views[i].world_to_camera[2, :3]
    similar_views = [j for j, view in enumerate(views) if j != i and view.world_to_camera[2, :3] @ direction > 0.5]
    return sorted(similar_views, key=lambda j: float(np.linalg.norm(views[j].position - position)))[:NEIGHBORS]


def _best_planes(
    i: int, views: Sequence[View], images: Sequence[Floats], neighbors: Sequence[int], inverse_depths: Floats
) -> NDArray[np.int64]:
    """Return the index of each pixel's best plane, [H, W].

    The best plane has the lowest cost.  The cost is the mean color difference to the better half of the adjacent views
    (rounded up), since the others may not show the surface.  The index is 0 where no plane is clearly the best: in
    uniform areas, and where no adjacent view shows the surface.
    """
    view, image = views[i], images[i]
    costs = np.empty((len(inverse_depths), *image.shape[:2]), np.float32)
    for plane, inverse_depth in enumerate(inverse_depths):
        differences = []
        for j in neighbors:
            matrix = _homography(view, views[j], inverse_depth)
            size = view.camera.width, view.camera.height
            warped_image = cv2.warpPerspective(
                images[j], matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=(9, 9, 9)
            )
            differences.append(cv2.blur(np.minimum(np.abs(warped_image - image).sum(axis=2), 1), (WINDOW, WINDOW)))
        sorted_differences = np.sort(np.stack(differences), axis=0) if differences else np.ones((1, *image.shape[:2]))
        costs[plane] = sorted_differences[: -(-len(sorted_differences) // 2)].mean(axis=0)
    return np.where(costs.min(axis=0) < MAX_COST_RATIO * costs.mean(axis=0), costs.argmin(axis=0), 0)


def _homography(view: View, other: View, inverse_depth: float) -> Floats:
    """Return the homography from pixels of `view` to those of `other` for a plane at a depth in `view`, [3, 3]."""
    rotation = other.world_to_camera[:, :3] @ view.world_to_camera[:, :3].T
    translation = other.world_to_camera[:, 3] - rotation @ view.world_to_camera[:, 3]
    plane = rotation + np.outer(translation, [0, 0, inverse_depth])
    matrix: Floats = _calibration(other) @ plane @ np.linalg.inv(_calibration(view))
    return matrix


def _calibration(view: View) -> Floats:
    c = view.camera  # subtract 1/2, because OpenCV has pixel centers at integers
    return np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])


def _unproject(view: View, rows: Indices, columns: Indices, depth: Floats) -> Floats:
    """Return the world positions, [M, 3], of M pixels at depths `depth`, [M]."""
    c = view.camera
    rays = np.stack([(columns + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(depth))], axis=1)
    points: Floats = (rays * depth[:, None] - view.world_to_camera[:, 3]) @ view.world_to_camera[:, :3]
    return points


def _project(view: View, points: Floats) -> tuple[NDArray[np.bool_], Indices, Indices, Floats]:
    """Return a mask, [M], of the points that project into the image of a view, and the rows, columns and depths of all.

    points: [M, 3].  The depth of points behind the camera is 1.
    """
    camera, pose = view.camera, view.world_to_camera
    x, y, z = (points @ pose[:, :3].T + pose[:, 3]).T
    is_in_front = z > 0
    depth = np.where(is_in_front, z, 1)
    column = np.floor(x / depth * camera.fx + camera.cx).clip(-1, camera.width).astype(int)
    row = np.floor(y / depth * camera.fy + camera.cy).clip(-1, camera.height).astype(int)
    is_visible = is_in_front & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return is_visible, row, column, depth


def _confirm(
    i: int, views: Sequence[View], planes: Sequence[NDArray[np.int64]], neighbors: Sequence[int], inverse_depths: Floats
) -> NDArray[np.bool_]:
    """Return a mask, [H, W], of the pixels whose depth enough adjacent views confirm.

    Pixels on the nearest and on the farthest plane are not in the mask.
    """
    shape = planes[i].shape
    rows, columns = (index.ravel() for index in np.indices(shape))
    points = _unproject(views[i], rows, columns, 1 / inverse_depths[planes[i].ravel()])
    votes = np.zeros(len(points), int)
    for j in neighbors:
        is_visible, row, column, depth = _project(views[j], points)
        surface = inverse_depths[planes[j][row * is_visible, column * is_visible]]
        votes += is_visible & (np.abs(surface - 1 / depth) < MAX_DIFFERENCE * (inverse_depths[1] - inverse_depths[0]))
    is_inner = (planes[i] > 0) & (planes[i] < len(inverse_depths) - 1)
    return np.asarray((votes >= MIN_VOTES).reshape(shape) & is_inner)
