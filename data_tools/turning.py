"""Whether a camera only turned on the spot: then no depth can be known, and a model of it would be made up.

Photographs of a camera that turns by R are related by the homography H = K R K⁻¹ (Hartley and Zisserman 2004, 13.2), so
that K⁻¹ H K is a rotation for one focal length and all pairs.  A plane that fills the photographs gives homographies
too, but R + t nᵀ/d is no rotation.
"""

from collections.abc import Sequence, Set
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from data_tools.database import opened
from data_tools.reasons import FEW_MATCHES

PHOTOGRAPHS = 60  # that are looked at, evenly spaced, each with the one that it has the most matches with
NEAR = 3.0  # px: of a match that a homography explains
EXPLAINED = 0.9  # share of the matches of a pair
FOCALS = np.geomspace(0.4, 4.0, 47)  # of the longer side
MADE_UP = 0.1  # how far K⁻¹ H K may be from a rotation, by how far that is from no turn at all
Floats = NDArray[np.float64]


def only_turned(pycolmap: ModuleType, database: Path, names: Set[str] | None = None) -> bool:
    """Return whether nearly all of the named photographs match another one as those of a camera that turned.

    Without names: of those that match another one well, where these are half of the photographs at least.  A stranger
    among them tells nothing; of fewer, further attempts may find more matches.
    """
    with opened(pycolmap, database) as rows:
        images = {image.image_id: image for image in rows.read_all_images()}
        sizes = {camera.camera_id: (camera.width, camera.height) for camera in rows.read_all_cameras()}
        chosen = {number for number, image in images.items() if names is None or image.name in names}
        best = _best_pairs(pycolmap, rows, chosen)
        known = sorted(best) if names is None else sorted(chosen)
        if 2 * len(known) < len(chosen):
            return False
        sample = known[:: max(1, -(-len(known) // PHOTOGRAPHS))]
        pairs = [best[number] for number in sample if number in best]
        points = {}
        for number in {one for pair, _ in pairs for one in pycolmap.pair_id_to_image_pair(pair)}:
            size = np.array(sizes[images[number].camera_id])
            points[number] = (rows.read_keypoints(number)[:, :2] - size / 2) / size.max(), float(size.max())
    found = []
    for pair, geometry in pairs:
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches)
        matrix = _homography(points[a][0][matches[:, 0]], points[b][0][matches[:, 1]], NEAR / points[b][1])
        if matrix is not None:
            found.append(matrix)
    is_most = len(found) > 1 and len(found) >= EXPLAINED * len(sample)
    return is_most and min(_from_turns(found, focal) for focal in FOCALS) < MADE_UP


def _best_pairs(pycolmap: ModuleType, rows: Any, chosen: Set[int]) -> dict[int, tuple[int, Any]]:
    """The pair of the most matches between photographs of these, with its geometry, by photograph that matches well."""
    found: dict[int, tuple[int, Any]] = {}
    for pair, geometry in zip(*rows.read_two_view_geometries(), strict=True):
        both = pycolmap.pair_id_to_image_pair(pair)
        if len(geometry.inlier_matches) >= FEW_MATCHES and set(both) <= chosen:
            for number in both:
                if number not in found or len(geometry.inlier_matches) > len(found[number][1].inlier_matches):
                    found[number] = pair, geometry
    return found


def _homography(first: Floats, second: Floats, near: float) -> Floats | None:
    """The homography that explains nearly all matches of a pair, in units of the longer side from the middle."""
    matrix, explained = cv2.findHomography(first, second, cv2.RANSAC, near)
    if matrix is None or explained.mean() < EXPLAINED:
        return None
    return np.asarray(matrix, np.float64)


def _from_turns(homographies: Sequence[Floats], focal: float) -> float:
    """The middle distance of homographies from turns, by that from no turn, for a focal length."""
    scale = np.diag([focal, focal, 1.0])
    found = []
    for matrix in homographies:
        turn = np.linalg.inv(scale) @ matrix @ scale
        turn /= np.cbrt(np.linalg.det(turn))
        off = float(np.linalg.norm(turn @ turn.T - np.eye(3)))
        found.append(off / max(float(np.linalg.norm(turn - np.eye(3))), 1e-9))
    return float(np.median(found))
