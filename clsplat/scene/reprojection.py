"""How far the points of a dataset are from where its photographs show them."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.tracks import Tracks
from clsplat.scene.view import View

Floats = NDArray[np.float64]
EXACT = 1e-3  # px: below it places were computed from the cameras, and tell nothing of them


def misses(view: View, positions: NDArray[np.floating], places: Floats) -> Floats:
    """Return the vectors, [K, 2] px, from where a view at its full size shows positions, [K, 3], to places, [K, 2] px
    of the photograph as it was taken; NaN behind the camera, and for places far outside the photograph."""
    points = np.einsum("ij,nj->ni", view.world_to_camera[:, :3], positions) + view.world_to_camera[:, 3]
    camera, taken = view.camera, view.lens or view.camera
    size = np.array([taken.width, taken.height])
    near = (np.abs(places - size / 2) <= size).all(axis=1)  # a place of a damaged file says nothing of cameras
    points[~(near & (points[:, 2] > 0))] = np.nan
    with np.errstate(all="ignore"):
        if view.lens is not None:
            return np.asarray(places - view.lens.project(points))
        return np.asarray(places - points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) - (camera.cx, camera.cy))


def reprojection_errors(tracks: Tracks | None, views: Iterable[View]) -> Floats | None:
    """Return the mean distance for each point that views show, px at their sizes; None where the dataset does not tell
    it."""
    if tracks is None or not tracks.misses:
        return None
    sums, counts = np.zeros(len(tracks.positions)), np.zeros(len(tracks.positions))
    for view in views:
        distances = np.linalg.norm(tracks.misses.get(view.name, np.empty((0, 2))), axis=1) / view.downscale
        known = np.isfinite(distances)
        if known.any():
            np.add.at(sums, tracks.seen[view.name][known], distances[known])
            np.add.at(counts, tracks.seen[view.name][known], 1)
    errors = sums[counts > 0] / counts[counts > 0]
    return errors if len(errors) and errors.mean() > EXACT else None
