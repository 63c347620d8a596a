"""Detect cameras that only rotated in place: their photographs have no parallax, so depth cannot be estimated.

Photographs of a camera that rotates by R are related by the homography H = K R K⁻¹ (Hartley and Zisserman 2004, 13.2),
so K⁻¹ H K is a rotation for all pairs, with one focal length.  A plane that fills the photographs also gives
homographies, but R + t nᵀ/d is not a rotation.
"""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.prepare.database import open_database
from clsplat.prepare.diagnosis import FEW_MATCHES, connected_groups

MAX_PAIRS = 120  # pairs to test, spaced evenly after sorting by the number of matches
MAX_RESIDUAL = 3.0  # px: largest residual of a match that a homography explains, and largest motion of a static point
MIN_EXPLAINED = 0.9  # fraction of the matches of a pair that fit its homography, and of the pairs that fit a rotation
FOCALS = np.geomspace(0.4, 4.0, 47)  # focal lengths to try, as fractions of the longer side
MAX_DEVIATION = 0.1  # of K⁻¹ H K from a rotation, relative to its deviation from the identity
REMEDY = "so depth cannot be estimated; walk around the scene, taking a photo every step"
ROTATED = f"look as if the camera only rotated in place, {REMEDY}"
SAME = f"are all the same, {REMEDY}"
Floats = NDArray[np.float64]


def explain_missing_depth(pycolmap: ModuleType, database: Path, names: Set[str] | None = None) -> str:
    """Explain why depth cannot be estimated from photographs; return "" if that may be possible.

    names: the photographs; None: all.

    All good pairs are tested, since the best pair of each photograph may come from one of several viewpoints.  The
    reconstruction is not tested: even for a purely rotating camera, COLMAP may find parallax of a few degrees.  If the
    pairs cover less than half of the photographs, the result is "", since further attempts may find more pairs.
    """
    with open_database(pycolmap, database) as db:
        all_names = {image.image_id: image.name for image in db.read_all_images()}
        names_by_id = {image_id: name for image_id, name in all_names.items() if names is None or name in names}
        pairs = _read_good_pairs(pycolmap, db, names_by_id.keys())
        if not names_by_id or 2 * len({image_id for pair in pairs for image_id in pair.photographs}) < len(names_by_id):
            return ""
        moving_pairs = [pair for pair in pairs if not _is_still(*pair.points())]
        if not moving_pairs:
            still_pairs = [(names_by_id[a], names_by_id[b]) for a, b in (pair.photographs for pair in pairs)]
            return SAME if len(connected_groups(names_by_id.values(), still_pairs)) == 1 else ""
        sample = moving_pairs[:: -(-len(moving_pairs) // MAX_PAIRS)]
        homographies = [matrix for pair in sample if (matrix := _fit_homography(*pair.points())) is not None]
    if len(homographies) < 2 or len(homographies) < MIN_EXPLAINED * len(sample):
        return ""
    return ROTATED if min(_rotation_deviation(homographies, focal) for focal in FOCALS) < MAX_DEVIATION else ""


@dataclass(frozen=True)
class _Pair:
    """Two photographs with matches."""

    photographs: tuple[int, int]  # image IDs
    matches: NDArray[np.uint32]  # [M, 2], indices of the points of each photograph
    points_of: Callable[[int], tuple[Floats, float]]  # points of a photograph, [N, 2], and size of a pixel, by image ID

    def points(self) -> tuple[Floats, Floats, float]:
        """Return the matched points of both photographs, [M, 2] each, and the size of a pixel.

        The unit is the longer side of a photograph, the origin its center.
        """
        (first, _), (second, pixel_size) = map(self.points_of, self.photographs)
        return first[self.matches[:, 0]], second[self.matches[:, 1]], pixel_size


def _read_good_pairs(pycolmap: ModuleType, db: Any, image_ids: Set[int]) -> list[_Pair]:
    """Return the pairs of photographs that have enough matches, the pair with the most matches first."""
    sizes = {camera.camera_id: np.array([camera.width, camera.height]) for camera in db.read_all_cameras()}

    @cache
    def points_of(image_id: int) -> tuple[Floats, float]:
        size = sizes[db.read_image(image_id).camera_id]
        return (db.read_keypoints(image_id)[:, :2] - size / 2) / size.max(), 1 / float(size.max())

    pairs = [
        _Pair(pycolmap.pair_id_to_image_pair(pair), np.asarray(geometry.inlier_matches), points_of)
        for pair, geometry in zip(*db.read_two_view_geometries(), strict=True)
    ]
    good_pairs = [pair for pair in pairs if len(pair.matches) >= FEW_MATCHES and set(pair.photographs) <= image_ids]
    return sorted(good_pairs, key=lambda pair: -len(pair.matches))


def _is_still(first: Floats, second: Floats, pixel_size: float) -> bool:
    """Return whether the points of two photographs do not move, so that the pair does not show the camera's motion."""
    return bool(np.median(np.linalg.norm(second - first, axis=1)) < MAX_RESIDUAL * pixel_size)


def _fit_homography(first: Floats, second: Floats, pixel_size: float) -> Floats | None:
    """Return the homography, [3, 3], that explains nearly all matches of a pair, or None if there is none."""
    matrix, inliers = cv2.findHomography(first, second, cv2.RANSAC, MAX_RESIDUAL * pixel_size)
    if matrix is None or inliers.mean() < MIN_EXPLAINED:
        return None
    return np.asarray(matrix, np.float64)


def _rotation_deviation(homographies: Sequence[Floats], focal: float) -> float:
    """Return the median deviation of homographies from rotations, relative to their deviation from the identity."""
    scale = np.diag([focal, focal, 1.0])
    deviations = []
    for matrix in homographies:
        rotation = np.linalg.inv(scale) @ matrix @ scale
        rotation /= np.cbrt(np.linalg.det(rotation))
        deviation = float(np.linalg.norm(rotation @ rotation.T - np.eye(3)))
        deviations.append(deviation / max(float(np.linalg.norm(rotation - np.eye(3))), 1e-9))
    return float(np.median(deviations))
