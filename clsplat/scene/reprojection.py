"""How far the points of a dataset are from where its photographs show them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.scene.scene import PointCloud, Scene, Tracks
from clsplat.scene.view import View, photo_lens

Floats = NDArray[np.float64]
NEAR = 1.0  # px at the size of training, ours: beyond it a pixel does not show the point
EXACT = 1e-3  # px: below it places were computed from the cameras, and tell nothing of them


def reprojection_residuals(view: View, positions: NDArray[np.floating], places: Floats) -> Floats:
    """Return the vectors, [K, 2] px, from where a view at its full size shows positions, [K, 3], to places, [K, 2] px
    of the photograph as it was taken; NaN behind the camera, and for places far outside the photograph."""
    taken = view.lens or view.camera
    size = np.array([taken.width, taken.height])
    # a place of a damaged file says nothing of cameras
    near = np.all(np.abs(places - size / 2) <= size, axis=1, keepdims=True)
    return np.where(near, places - project_points(view, positions), np.nan)


def project_points(view: View, positions: NDArray[np.floating]) -> Floats:
    """Return where a view at its full size shows positions, [K, 3]: [K, 2] px of the photograph as it was taken, NaN
    behind the camera."""
    points = np.einsum("ij,nj->ni", view.world_to_camera[:, :3], positions) + view.world_to_camera[:, 3]
    points[~(points[:, 2] > 0)] = np.nan
    with np.errstate(all="ignore"):
        if view.lens is not None:
            return photo_lens(view).project(points)
        camera = view.camera
        return np.asarray(points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def replace_cameras(scene: Scene, views: Sequence[View]) -> Scene:
    """Return a scene, at its full size, whose views have other cameras; photographs show its points where they did."""
    tracks, missed = scene.tracks, dict[str, Floats]()
    if tracks is not None:
        for old, new in zip(scene.views, views, strict=True):
            if old.name in tracks.residuals:
                positions = tracks.positions[tracks.seen[old.name]]
                moved = project_points(old, positions) - project_points(new, positions)
                missed[old.name] = tracks.residuals[old.name] + moved
        tracks = replace(tracks, residuals={**tracks.residuals, **missed})
    return replace(scene, views=tuple(views), tracks=tracks)


def reprojection_errors(tracks: Tracks | None, views: Iterable[View]) -> Floats | None:
    """Return the mean distance for each point that views show, px at their sizes; None where the dataset does not tell
    it."""
    if tracks is None or not tracks.residuals:
        return None
    sums, counts = np.zeros(len(tracks.positions)), np.zeros(len(tracks.positions))
    for view in views:
        distances = np.linalg.norm(tracks.residuals.get(view.name, np.empty((0, 2))), axis=1) / view.downscale
        known = np.isfinite(distances)
        if known.any():
            np.add.at(sums, tracks.seen[view.name][known], distances[known])
            np.add.at(counts, tracks.seen[view.name][known], 1)
    errors = sums[counts > 0] / counts[counts > 0]
    return errors if len(errors) and errors.mean() > EXACT else None


def filter_tracks(tracks: Tracks, views: Iterable[View], limit: float = NEAR) -> Tracks:
    """Return the tracks without the points that views show `limit` px or more, at their sizes, from where the cameras
    do; a view without known places keeps all of its points, and so do other views than these."""
    seen, missed = dict(tracks.seen), dict(tracks.residuals)
    for view in sorted(views, key=lambda view: -view.downscale):  # of a photograph in several sizes the largest one
        if view.name in tracks.residuals:
            found = tracks.residuals[view.name]
            kept = ~(np.linalg.norm(found, axis=1) / view.downscale >= limit)  # NaN: not known
            seen[view.name], missed[view.name] = tracks.seen[view.name][kept], found[kept]
    return Tracks(tracks.positions, seen, missed)


def require_points_in_front(points: PointCloud, scene: Scene) -> None:
    """Raise DataError when every point lies behind every training camera."""
    poses = np.stack([view.world_to_camera for view in scene.split("train")])
    if not any((points.positions @ pose[2, :3] + pose[2, 3] > 0).any() for pose in poses):
        raise DataError(
            f"{scene.path}: all {len(points):,} points lie behind all training cameras; poses and points follow "
            "different conventions: export both again, or use init: {source: sweep}"
        )
