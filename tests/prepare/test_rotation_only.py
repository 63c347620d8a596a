"""Whether matches give depth: rotating cameras at one or several positions, and copies of photographs."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.prepare.database import open_database
from clsplat.prepare.rotation_only import explain_missing_depth

WIDTH, HEIGHT, FOCAL = 1000, 750, 800.0


def matches_of(folder: Path, cameras: Sequence[tuple[float, float]]) -> Path:
    """A database of photographs of a cloud of points, by places along a line and angles in degrees, all matched."""
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    points = rng.uniform((-6, -3, 4), (6, 3, 10), (1200, 3))
    seen = []
    with open_database(pycolmap, folder / "database.db") as rows:
        lens = {"model": "SIMPLE_PINHOLE", "width": WIDTH, "height": HEIGHT, "params": [FOCAL, WIDTH / 2, HEIGHT / 2]}
        camera = rows.write_camera(pycolmap.Camera(**lens))
        for number, (place, angle) in enumerate(cameras):
            turn, _ = cv2.Rodrigues(np.array([0, np.radians(angle), 0]))
            at = (points - (place, 0.1 * place, 0)) @ turn.T
            pixels = at[:, :2] / at[:, 2:] * FOCAL + (WIDTH / 2, HEIGHT / 2)
            shown = np.nonzero((at[:, 2] > 0) & (pixels > 0).all(axis=1) & (pixels < (WIDTH, HEIGHT)).all(axis=1))[0]
            image = rows.write_image(pycolmap.Image(name=f"{number:02}.jpg", camera_id=camera))
            rows.write_keypoints(image, (pixels[shown] + rng.normal(0, 0.5, (len(shown), 2))).astype(np.float32))
            seen.append((image, place, shown))
        for row, (a, here, left) in enumerate(seen):
            for b, there, right in seen[row + 1 :]:
                both = np.intersect1d(left, right)
                both = both[rng.random(len(both)) < (0.9 if here == there else 0.4)]  # a step away, fewer match
                geometry = pycolmap.TwoViewGeometry()
                places = [np.searchsorted(left, both), np.searchsorted(right, both)]
                geometry.inlier_matches = np.column_stack(places).astype(np.uint32)
                rows.write_two_view_geometry(a, b, geometry)
    return folder / "database.db"


def reason_for(folder: Path, cameras: Sequence[tuple[float, float]]) -> str:
    return explain_missing_depth(pytest.importorskip("pycolmap"), matches_of(folder, cameras))


def test_rotating_camera_gives_no_depth(tmp_path):
    assert "only rotated in place" in reason_for(tmp_path, [(0, angle) for angle in range(-20, 21, 8)])


def test_camera_rotating_at_several_positions_gives_depth(tmp_path):
    """Each photograph matches those of its own spot best."""
    assert reason_for(tmp_path, [(0.6 * spot, angle) for spot in range(-3, 3) for angle in (-12, 0, 12)]) == ""


def test_copies_of_one_photograph_are_duplicates(tmp_path):
    assert "are all the same" in reason_for(tmp_path, [(0, 0)] * 4)


def test_copies_of_two_photographs_are_not_all_duplicates(tmp_path):
    assert reason_for(tmp_path, [(0, -60), (0, -60), (0, 60), (0, 60)]) == "", "different places, twice each"
