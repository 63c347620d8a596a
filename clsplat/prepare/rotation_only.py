"""Whether a camera only turned on the spot: then no depth can be known, and a model of it would be made up.

Photographs of a camera that turns by R are related by the homography H = K R K⁻¹ (Hartley and Zisserman 2004, 13.2), so
that K⁻¹ H K is a rotation for one focal length and all pairs.  A plane that fills the photographs gives homographies
too, but R + t nᵀ/d is no rotation.
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

from clsplat.prepare.database import opened
from clsplat.prepare.diagnosis import FEW_MATCHES, connected_groups

PAIRS = 120  # that are looked at, evenly spaced from those with the most matches to those with the fewest
NEAR = 3.0  # px: of a match that a homography explains, and of a point that has not moved
EXPLAINED = 0.9  # share of the matches of a pair, and of the pairs
FOCALS = np.geomspace(0.4, 4.0, 47)  # of the longer side
MADE_UP = 0.1  # how far K⁻¹ H K may be from a rotation, by how far that is from no turn at all
WALK = "which tells no depth; walk around the scene, a step between photographs"
TURNED = f"match like those of a camera that only turned on the spot, {WALK}"
SAME = f"are all the same: nothing moves from one to the next, {WALK}"
Floats = NDArray[np.float64]


def why_no_depth(pycolmap: ModuleType, database: Path, names: Set[str] | None = None) -> str:
    """Return in words why the photographs, or the named ones of them, tell no depth; "" where they may.

    All pairs that match well are asked: the best one of each photograph may be of one spot, where there are several.  A
    model is not: of a camera that only turned, COLMAP makes one up, whose points have angles of some degrees.
    Where the pairs are of fewer than half of the photographs, they tell nothing: further attempts may find more.
    """
    with opened(pycolmap, database) as rows:
        images = {image.image_id: image.name for image in rows.read_all_images()}
        chosen = {number: name for number, name in images.items() if names is None or name in names}
        pairs = _good_pairs(pycolmap, rows, chosen.keys())
        if not chosen or 2 * len({number for pair in pairs for number in pair.photographs}) < len(chosen):
            return ""
        moving = [pair for pair in pairs if not _is_still(*pair.points())]
        if not moving:
            still = [(chosen[a], chosen[b]) for a, b in (pair.photographs for pair in pairs)]
            return SAME if len(connected_groups(chosen.values(), still)) == 1 else ""
        sample = moving[:: -(-len(moving) // PAIRS)]
        found = [matrix for pair in sample if (matrix := _homography(*pair.points())) is not None]
    is_most = len(found) > 1 and len(found) >= EXPLAINED * len(sample)
    return TURNED if is_most and min(_from_turns(found, focal) for focal in FOCALS) < MADE_UP else ""


@dataclass(frozen=True)
class _Pair:
    """Two photographs with their matches, [M, 2], and a function of the points of a photograph and its pixel."""

    photographs: tuple[int, int]
    matches: NDArray[np.uint32]
    points_of: Callable[[int], tuple[Floats, float]]

    def points(self) -> tuple[Floats, Floats, float]:
        """The matched points of both, and the size of a pixel."""
        (first, _), (second, pixel) = map(self.points_of, self.photographs)
        return first[self.matches[:, 0]], second[self.matches[:, 1]], pixel


def _good_pairs(pycolmap: ModuleType, rows: Any, chosen: Set[int]) -> list[_Pair]:
    """The pairs of the chosen photographs with matches enough, those with the most first."""
    sizes = {camera.camera_id: np.array([camera.width, camera.height]) for camera in rows.read_all_cameras()}

    @cache
    def points_of(number: int) -> tuple[Floats, float]:
        size = sizes[rows.read_image(number).camera_id]
        return (rows.read_keypoints(number)[:, :2] - size / 2) / size.max(), 1 / float(size.max())

    read = zip(*rows.read_two_view_geometries(), strict=True)
    found = [
        _Pair(pycolmap.pair_id_to_image_pair(pair), np.asarray(geometry.inlier_matches), points_of)
        for pair, geometry in read
    ]
    good = [pair for pair in found if len(pair.matches) >= FEW_MATCHES and set(pair.photographs) <= chosen]
    return sorted(good, key=lambda pair: -len(pair.matches))


def _is_still(first: Floats, second: Floats, pixel: float) -> bool:
    """Whether nothing moves between two photographs, such as copies, which tell nothing of a camera."""
    return bool(np.median(np.linalg.norm(second - first, axis=1)) < NEAR * pixel)


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
