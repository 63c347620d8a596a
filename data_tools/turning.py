"""Whether a camera only turned on the spot: then no depth can be known, and a model of it would be made up.

Photographs of a camera that turns by R are related by the homography H = K R K⁻¹ (Hartley and Zisserman 2004, 13.2), so
that K⁻¹ H K is a rotation for one focal length and all pairs.  A plane that fills the photographs gives homographies
too, but R + t nᵀ/d is no rotation.
"""

from collections.abc import Sequence, Set
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from data_tools.database import opened
from data_tools.reasons import FEW_MATCHES

PHOTOGRAPHS = 60  # that are looked at, evenly spaced, each with the one that it has the most matches with
NEAR = 3.0  # px: of a match that a homography explains, and of a point that has not moved
EXPLAINED = 0.9  # share of the matches of a pair
FOCALS = np.geomspace(0.4, 4.0, 47)  # of the longer side
MADE_UP = 0.1  # how far K⁻¹ H K may be from a rotation, by how far that is from no turn at all
WALK = "which tells no depth; walk around the scene, a step between photographs"
TURNED = f"match like those of a camera that only turned on the spot, {WALK}"
SAME = f"are all the same: nothing moves from one to the next, {WALK}"
Floats = NDArray[np.float64]


def without_depth(pycolmap: ModuleType, database: Path, names: Set[str] | None = None) -> str:
    """Return in words why the photographs, or the named ones of them, tell no depth; "" where they may.

    Those that match another one well are looked at, where these are half of them at least: a stranger among them tells
    nothing, and of fewer, further attempts may find more matches.
    """
    with opened(pycolmap, database) as rows:
        images = {image.image_id: image for image in rows.read_all_images()}
        chosen = {number for number, image in images.items() if names is None or image.name in names}
        moved, still = _best_pairs(pycolmap, rows, chosen)
    if 2 * len(moved.keys() | still) < len(chosen) or not chosen:
        return ""
    if not moved:
        return SAME
    sample = sorted(moved)[:: -(-len(moved) // PHOTOGRAPHS)]
    found = [matrix for number in sample if (matrix := _homography(*moved[number])) is not None]
    is_most = len(found) > 1 and len(found) >= EXPLAINED * len(sample)
    return TURNED if is_most and min(_from_turns(found, focal) for focal in FOCALS) < MADE_UP else ""


def _best_pairs(
    pycolmap: ModuleType, rows: Any, chosen: Set[int]
) -> tuple[dict[int, tuple[Floats, Floats, float]], set[int]]:
    """By photograph, the matched points of its pair of the most matches between which something moves, and a pixel; and
    the photographs of pairs between which nothing moves, such as copies, which tell nothing of a camera."""
    moved, still = dict[int, tuple[Floats, Floats, float]](), set[int]()
    sizes = {camera.camera_id: np.array([camera.width, camera.height]) for camera in rows.read_all_cameras()}

    @cache
    def points(number: int) -> tuple[Floats, float]:
        size = sizes[rows.read_image(number).camera_id]
        return (rows.read_keypoints(number)[:, :2] - size / 2) / size.max(), 1 / float(size.max())

    pairs = zip(*rows.read_two_view_geometries(), strict=True)
    for pair, geometry in sorted(pairs, key=lambda one: -len(one[1].inlier_matches)):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches)
        if len(matches) < FEW_MATCHES or not {a, b} <= chosen or (a in moved and b in moved):
            continue
        (first, _), (second, pixel) = points(a), points(b)
        first, second = first[matches[:, 0]], second[matches[:, 1]]
        if np.median(np.linalg.norm(second - first, axis=1)) < NEAR * pixel:
            still |= {a, b}
            continue
        for number in (a, b):
            moved.setdefault(number, (first, second, pixel))
    return moved, still


def _homography(first: Floats, second: Floats, pixel: float) -> Floats | None:
    """The homography that explains nearly all matches of a pair, in units of the longer side from the middle."""
    matrix, explained = cv2.findHomography(first, second, cv2.RANSAC, NEAR * pixel)
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
