"""Where the borders of blocks lie in test views, and what runs show there."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.density.control import Box
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.sweeps.compare.crops import find_seams
from clsplat.workflows.blocks import is_near, places
from clsplat.workflows.partition import PartitionCell

SIZE = np.array([10.0, 10.0, 10.0])
CELLS = [PartitionCell(Box(high=[2.0, None, None]), SIZE), PartitionCell(Box(low=[2.0, None, None]), SIZE)]


def test_a_point_is_near_a_face_of_its_own_cell():
    points = np.array([[1.4, 0, 0], [1.6, 9, 9], [2.0, 0, 0], [2.4, -7, 0], [2.6, 0, 0], [np.nan, 0, 0]])
    assert is_near(points, CELLS).tolist() == [False, True, True, True, False, False]
    assert not is_near(points, [PartitionCell(Box(), SIZE)]).any(), "a whole has no borders"


def test_pixels_lie_where_the_camera_sees_them():
    view = View.looking_at([3.0, 1.0, 8.0], [3.0, 1.0, 0.0], [0.0, 1.0, 0.0], Camera(4, 2, 10.0, 10.0, 2.0, 1.0))
    depth = np.full((2, 4), 8.0)
    found = places(view, depth)
    pose = np.asarray(view.world_to_camera)
    seen = found @ pose[:, :3].T + pose[:, 3]
    np.testing.assert_allclose(seen[..., 2], 8.0)
    np.testing.assert_allclose(seen[0, 0, :2], np.array([0.5 - 2.0, 0.5 - 1.0]) * 0.8)
    np.testing.assert_allclose(found[..., 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.mean(axis=(0, 1))[:2], [3.0, 1.0])


@pytest.fixture
def runs(tmp_path: Path) -> tuple[list[SimpleNamespace], SimpleNamespace]:
    """Two runs with a view of 4x2 px, whose first column is a band in the second run, and their scene."""

    def store(path: Path, image: np.ndarray) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), image)
        return path

    grey = np.full((2, 4, 3), 100, np.uint8)
    photograph, band = store(tmp_path / "photo" / "a.png", grey), np.zeros((2, 4), np.uint8)
    band[:, 0] = 255
    wrong = grey.copy()
    wrong[:, 0] += 10
    found = []
    for name, image in (("whole", grey + np.uint8(1)), ("merged", wrong)):
        store(tmp_path / name / "renders" / "a.png", image)
        found.append(SimpleNamespace(path=tmp_path / name, renders=tmp_path / name / "renders"))
    store(tmp_path / "merged" / "seams" / "a.png", band)
    camera = Camera(4, 2, 10.0, 10.0, 2.0, 1.0)
    return found, SimpleNamespace(views=[View("a", camera, np.eye(3, 4), photograph)])


def test_all_runs_are_measured_in_the_band_of_the_blocks(runs):
    own, scene = runs
    found = find_seams(own, scene, "black")
    assert found is not None
    assert (found.share, found.views, found.view) == (0.25, 1, "a")
    one, ten = (10 * np.log10(255**2 / error) for error in (1, 100))
    np.testing.assert_allclose(found.band, [one, ten])
    np.testing.assert_allclose(found.rest, [one, np.inf])
    assert (found.picture[:, 1:] == 100).all()
    assert (found.picture[:, 0] == [177, 82, 82]).all()


def test_without_blocks_there_are_no_seams(runs):
    own, scene = runs
    assert find_seams(own[:1], scene, "black") is None
    (own[1].path / "seams" / "a.png").unlink()
    assert find_seams(own, scene, "black") is None


def test_a_mask_of_another_size_is_named(runs):
    own, scene = runs
    cv2.imwrite(str(own[1].path / "seams" / "a.png"), np.full((4, 2), 255, np.uint8))
    with pytest.raises(DataError, match=r"seams.a\.png: is 2x4 px; expected 4x2 as the photograph"):
        find_seams(own, scene, "black")
