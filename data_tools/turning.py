"""Whether a camera only turned on the spot: then no depth can be known, and a model of it would be made up.

Photographs of a camera that turns by R are related by the homography H = K R K⁻¹ (Hartley and Zisserman 2004, 13.2), so
that K⁻¹ H K is a rotation for one focal length and all pairs.  A plane that fills the photographs gives homographies
too, but R + t nᵀ/d is no rotation.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from data_tools.database import opened

PHOTOGRAPHS = 60  # that are looked at, evenly spaced, each with the one that it has the most matches with
NEAR = 3.0  # px: of a match that a homography explains
EXPLAINED = 0.9  # share of the matches of a pair
FOCALS = np.geomspace(0.4, 4.0, 47)  # of the longer side
MADE_UP = 0.1  # how far K⁻¹ H K may be from a rotation, by how far that is from no turn at all
Floats = NDArray[np.float64]


def only_turned(pycolmap: ModuleType, database: Path) -> bool:
    """Return whether nearly all photographs match another one as those of a camera that turned."""
    homographies = _homographies(pycolmap, database)
    return len(homographies) > 1 and min(_from_turns(homographies, focal) for focal in FOCALS) < MADE_UP


def _homographies(pycolmap: ModuleType, database: Path) -> list[Floats]:
    """Homographies that explain the matches of photographs, in units of the longer side from the middle; none where
    they do not for one photograph of ten."""
    with opened(pycolmap, database) as rows:
        images = {image.image_id: image for image in rows.read_all_images()}
        cameras = {camera.camera_id: camera for camera in rows.read_all_cameras()}
        numbers, geometries = rows.read_two_view_geometries()
        names = sorted(images)
        sample = names[:: -(-len(names) // PHOTOGRAPHS)]
        best = _best_pairs(pycolmap, dict(zip(numbers, geometries, strict=True)))
        pairs = [best[number] for number in sample if number in best]
        points = {}
        for number in {one for pair, _ in pairs for one in pycolmap.pair_id_to_image_pair(pair)}:
            camera = cameras[images[number].camera_id]
            size = np.array([camera.width, camera.height])
            points[number] = (rows.read_keypoints(number)[:, :2] - size / 2) / size.max(), size.max()
    found = []
    for pair, geometry in pairs:
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches)
        if len(matches) >= 8:
            first, second = points[a][0][matches[:, 0]], points[b][0][matches[:, 1]]
            matrix, explained = cv2.findHomography(first, second, cv2.RANSAC, NEAR / points[b][1])
            if matrix is not None and explained.mean() >= EXPLAINED:
                found.append(np.asarray(matrix, np.float64))
    return found if len(found) >= EXPLAINED * len(sample) else []


def _best_pairs(pycolmap: ModuleType, geometries: Mapping[int, Any]) -> dict[int, tuple[int, Any]]:
    """The pair of the most matches, with its geometry, by photograph."""
    found: dict[int, tuple[int, Any]] = {}
    for pair, geometry in geometries.items():
        for number in pycolmap.pair_id_to_image_pair(pair):
            if number not in found or len(geometry.inlier_matches) > len(found[number][1].inlier_matches):
                found[number] = pair, geometry
    return found


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
