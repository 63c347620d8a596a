"""The facts about the sparse points of a dataset."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.parts import Parts
from clsplat.scene.points import MAX_VALUE
from clsplat.scene.reprojection import reprojection_errors
from clsplat.scene.view import View

SAMPLE_SIZE = 20_000  # points that coverage is measured on
MAX_DISTANCE = 100.0  # camera extents from the middle of the cameras: photographs resolve nothing beyond


@dataclass(frozen=True)
class PointFacts:
    """The sparse points.  Shares are of a sample of SAMPLE_SIZE points, evenly spaced in the file."""

    count: int
    not_finite: int
    distant: int  # beyond MAX_DISTANCE camera extents
    error_mean: float | None  # px
    error_90: float | None  # px; 90 % of the points have less
    in_two: float | None  # share that lies in the image of at least two views, hidden or not
    behind: float | None  # share that lies behind all cameras


def points_of(parts: Parts, extent: float | None, centres: NDArray[np.floating]) -> PointFacts:
    """Measure the points of a dataset that has some.  extent: of its cameras; centres: of these, [N, 3]."""
    assert parts.points is not None
    positions = parts.points.positions
    finite = (np.abs(positions) < MAX_VALUE).all(axis=1)
    known = _errors(parts, np.asarray(finite))
    good = positions[finite].astype(np.float64)
    distance = np.linalg.norm(good - np.median(centres, axis=0), axis=1) if len(centres) else np.empty(0)
    sample = good[:: max(1, -(-len(good) // SAMPLE_SIZE))]
    in_two, behind = _coverage(sample, parts.views) if len(sample) and parts.views else (None, None)
    return PointFacts(
        count=len(positions),
        not_finite=int(np.count_nonzero(~finite)),
        distant=int(np.count_nonzero(distance > MAX_DISTANCE * extent)) if extent else 0,
        error_mean=float(known.mean()) if len(known) else None,
        error_90=float(np.quantile(known, 0.9)) if len(known) else None,
        in_two=in_two,
        behind=behind,
    )


def _errors(parts: Parts, finite: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Reprojection errors of points, px at the full size: by where photographs show them, else as the file has them."""
    found = reprojection_errors(parts.scene.tracks, parts.scene.views) if parts.scene else None
    if found is not None:
        return found
    assert parts.points is not None
    error = parts.points.error[finite] if len(parts.points.error) else np.empty(0)
    known = error[np.isfinite(error) & (error > 0)]
    return known if len(np.unique(known)) > 1 else np.empty(0)  # a placeholder


def _coverage(points: NDArray[np.float64], views: Sequence[View]) -> tuple[float, float]:
    """Shares of points [M, 3] that project into at least two views, and that lie behind all of them."""
    inside, ahead = np.zeros(len(points), int), np.zeros(len(points), bool)
    for view in views:
        camera = view.camera
        x, y, z = view.world_to_camera[:, :3] @ points.T + view.world_to_camera[:, 3:]
        front = z > 0
        depth = np.where(front, z, 1)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside += front & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        ahead |= front
    return float((inside >= min(2, len(views))).mean()), float((~ahead).mean())
