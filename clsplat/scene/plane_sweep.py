"""Points for a scene without points: a plane sweep over its photographs (Collins 1996).

For every photograph and each of PLANES depths, the neighbours are projected onto the plane at that depth.  The surface
lies at the depth where they agree best.  A pixel becomes a point when its neighbours find the same depth.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import PointCloud, View

Floats = NDArray[np.floating]
Places = NDArray[np.integer]
LONG_SIDE = 160  # px of the photographs that are compared
PLANES = 64  # evenly spaced in inverse depth
MIN_DEPTH, MAX_DEPTH = 0.1, 20.0  # times the distance to what the cameras look at
NEIGHBOURS = 4  # photographs that each is compared with
WINDOW = 5  # px
MAX_COST_SHARE = 0.6  # of the best plane, by the mean of all planes
MIN_VOTES = 2  # neighbours that find the depth of a point too
MAX_DIFFERENCE = 1.5  # of agreeing depths, planes


def swept_points(
    views: Sequence[View], centre: Floats, load: Callable[[View], NDArray[np.uint8]], count: int, seed: int
) -> PointCloud:
    """Return at most `count` coloured points on the surfaces that neighbouring views agree on, perhaps none.

    centre: what the cameras look at, [3].  `load` returns the photograph of a view, [H, W, 3].
    """
    small = [
        view.resized(view.downscale * max(1.0, max(view.camera.width, view.camera.height) / LONG_SIDE))
        for view in views
    ]
    images = [load(view).astype(np.float32) / 255 for view in small]
    near = [_neighbours(i, small) for i in range(len(small))]
    distance = float(np.median([np.linalg.norm(view.position - centre) for view in small]))
    inverse = np.linspace(1 / (MAX_DEPTH * distance), 1 / (MIN_DEPTH * distance), PLANES)
    planes = [_best_planes(i, small, images, near[i], inverse) for i in range(len(small))]
    positions, colours = [], []
    for i, view in enumerate(small):
        rows, columns = np.nonzero(_confirmed(i, small, planes, near[i], inverse))
        points = _lifted(view, rows, columns, 1 / inverse[planes[i][rows, columns]])
        positions.append(points)
        colours.append(images[i][rows, columns])
    everywhere, everything = np.concatenate(positions), np.concatenate(colours)
    chosen = np.sort(np.random.default_rng([seed, count]).permutation(len(everywhere))[:count])
    return PointCloud(everywhere[chosen].astype(np.float32), everything[chosen])


def _neighbours(i: int, views: Sequence[View]) -> list[int]:
    """The views nearest to one, among those that look the same way within 60 degrees."""
    position, direction = views[i].position, views[i].world_to_camera[2, :3]
    alike = [j for j, view in enumerate(views) if j != i and view.world_to_camera[2, :3] @ direction > 0.5]
    return sorted(alike, key=lambda j: float(np.linalg.norm(views[j].position - position)))[:NEIGHBOURS]


def _best_planes(
    i: int, views: Sequence[View], images: Sequence[Floats], near: Sequence[int], inverse: Floats
) -> NDArray[np.int64]:
    """The plane of each pixel, [H, W], on which the better half of the neighbours differs least from it.

    0 where no plane stands out: flat colours, and what no neighbour shows.
    """
    view, image = views[i], images[i]
    costs = np.empty((len(inverse), *image.shape[:2]), np.float32)
    for plane, depth in enumerate(inverse):
        differences = []
        for j in near:
            matrix = _homography(view, views[j], depth)
            size = view.camera.width, view.camera.height
            warped = cv2.warpPerspective(
                images[j], matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=(9, 9, 9)
            )
            differences.append(cv2.blur(np.minimum(np.abs(warped - image).sum(axis=2), 1), (WINDOW, WINDOW)))
        stacked = np.sort(np.stack(differences), axis=0) if differences else np.ones((1, *image.shape[:2]))
        costs[plane] = stacked[: -(-len(stacked) // 2)].mean(axis=0)
    return np.where(costs.min(axis=0) < MAX_COST_SHARE * costs.mean(axis=0), costs.argmin(axis=0), 0)


def _homography(view: View, other: View, inverse_depth: float) -> Floats:
    """Pixels of `view` to those of `other` for points on the plane at that depth before `view`, [3, 3].

    OpenCV's pixels have whole centres, hence the halves.
    """
    rotation = other.world_to_camera[:, :3] @ view.world_to_camera[:, :3].T
    translation = other.world_to_camera[:, 3] - rotation @ view.world_to_camera[:, 3]
    plane = rotation + np.outer(translation, [0, 0, inverse_depth])
    matrix: Floats = _calibration(other) @ plane @ np.linalg.inv(_calibration(view))
    return matrix


def _calibration(view: View) -> Floats:
    c = view.camera
    return np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])


def _lifted(view: View, rows: Places, columns: Places, depth: Floats) -> Floats:
    """World points [M, 3] of pixels at a depth."""
    c = view.camera
    rays = np.stack([(columns + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(depth))], axis=1)
    points: Floats = (rays * depth[:, None] - view.world_to_camera[:, 3]) @ view.world_to_camera[:, :3]
    return points


def _confirmed(
    i: int, views: Sequence[View], planes: Sequence[NDArray[np.int64]], near: Sequence[int], inverse: Floats
) -> NDArray[np.bool_]:
    """Which pixels, [H, W], lie where enough neighbours find a surface too, and not on the first or last plane."""
    shape = planes[i].shape
    rows, columns = (index.ravel() for index in np.indices(shape))
    points = _lifted(views[i], rows, columns, 1 / inverse[planes[i].ravel()])
    votes = np.zeros(len(points), int)
    for j in near:
        camera, pose = views[j].camera, views[j].world_to_camera
        x, y, z = (points @ pose[:, :3].T + pose[:, 3]).T
        ahead = z > 0
        depth = np.where(ahead, z, 1)
        column = np.floor(x / depth * camera.fx + camera.cx).clip(-1, camera.width).astype(int)
        row = np.floor(y / depth * camera.fy + camera.cy).clip(-1, camera.height).astype(int)
        seen = ahead & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        found = inverse[planes[j][row * seen, column * seen]]
        votes += seen & (np.abs(found - 1 / depth) < MAX_DIFFERENCE * (inverse[1] - inverse[0]))
    middle = (planes[i] > 0) & (planes[i] < len(inverse) - 1)
    return np.asarray((votes >= MIN_VOTES).reshape(shape) & middle)
