"""Measure reprojection errors: distances between projected points and their observations in photographs."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.scene.scene import PointCloud, Scene, Tracks
from clsplat.scene.view import View, photo_lens

Floats = NDArray[np.float64]
MAX_ERROR = 1.0  # px at the training resolution (our choice): beyond it, the pixel does not show the point
EXACT = 1e-3  # px: with smaller errors, observations were computed from the cameras and say nothing about them


def reprojection_residuals(view: View, positions: NDArray[np.floating], observations: Floats) -> Floats:
    """Return the vectors, [K, 2], from the projections of `positions`, [K, 3], to their `observations`, [K, 2] px.

    Pixels are those of the original photograph.  The result is NaN for points behind the camera and for observations
    far outside of the photograph.
    """
    original = view.lens or view.camera
    size = np.array([original.width, original.height])
    is_plausible = np.all(np.abs(observations - size / 2) <= size, axis=1, keepdims=True)  # files may be damaged
    return np.where(is_plausible, observations - project_points(view, positions), np.nan)


def project_points(view: View, positions: NDArray[np.floating]) -> Floats:
    """Return the projections of positions, [K, 3], into the original photograph of a view, [K, 2] px.

    The result is NaN for positions behind the camera.
    """
    points = np.einsum("ij,nj->ni", view.world_to_camera[:, :3], positions) + view.world_to_camera[:, 3]
    points[~(points[:, 2] > 0)] = np.nan
    with np.errstate(all="ignore"):
        return photo_lens(view).project(points)


def replace_cameras(scene: Scene, views: Sequence[View]) -> Scene:
    """Return `scene`, which must be at full size, with the cameras of `views`; the observed pixels do not change."""
    tracks, residuals = scene.tracks, dict[str, Floats]()
    if tracks is not None:
        for old_view, new_view in zip(scene.views, views, strict=True):
            if old_view.name in tracks.residuals:
                positions = tracks.positions[tracks.rows[old_view.name]]
                displacement = project_points(old_view, positions) - project_points(new_view, positions)
                residuals[old_view.name] = tracks.residuals[old_view.name] + displacement
        tracks = replace(tracks, residuals={**tracks.residuals, **residuals})
    return replace(scene, views=tuple(views), tracks=tracks)


def reprojection_errors(tracks: Tracks | None, views: Iterable[View]) -> Floats | None:
    """Return the mean reprojection error, px at the size of the view, of each point that `views` observe.

    Returns None if the errors are unknown, or if the observations were computed from the cameras.
    """
    if tracks is None or not tracks.residuals:
        return None
    sums, counts = np.zeros(len(tracks.positions)), np.zeros(len(tracks.positions))
    for view in views:
        distances = np.linalg.norm(tracks.residuals.get(view.name, np.empty((0, 2))), axis=1) / view.downscale
        is_known = np.isfinite(distances)
        if is_known.any():
            np.add.at(sums, tracks.rows[view.name][is_known], distances[is_known])
            np.add.at(counts, tracks.rows[view.name][is_known], 1)
    errors = sums[counts > 0] / counts[counts > 0]
    return errors if len(errors) and errors.mean() > EXACT else None


def filter_tracks(tracks: Tracks, views: Iterable[View], limit: float = MAX_ERROR) -> Tracks:
    """Return a copy of the tracks that omits observations with a reprojection error of `limit` px or more.

    Errors are measured at the size of the view.  Views without known observations, and views that are not in `views`,
    keep all points.
    """
    rows, residuals = dict(tracks.rows), dict(tracks.residuals)
    for view in sorted(views, key=lambda view: -view.downscale):  # the largest size of a photograph comes last
        if view.name in tracks.residuals:
            vectors = tracks.residuals[view.name]
            is_accurate = ~(np.linalg.norm(vectors, axis=1) / view.downscale >= limit)  # True for NaN: an unknown error
            rows[view.name], residuals[view.name] = tracks.rows[view.name][is_accurate], vectors[is_accurate]
    return Tracks(tracks.positions, rows, residuals)


def require_points_in_front(points: PointCloud, scene: Scene) -> None:
    """Raise DataError when all points are behind all training cameras."""
    poses = np.stack([view.world_to_camera for view in scene.split("train")])
    if not any((points.positions @ pose[2, :3] + pose[2, 3] > 0).any() for pose in poses):
        raise DataError(
            f"{scene.path}: all {len(points):,} points are behind all training cameras; poses and points "
            "use different conventions: export both again, or use `init: {source: sweep}`"
        )
