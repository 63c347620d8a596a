"""The synthetic city: views from all sides, evenly spaced above it."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from clsplat.scene.detect import read_scene
from tests.support.city import FLIGHT, City

TINY = City(size=16, train=4, test=1, lots=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("city") / "city"
    write_dataset(out, TINY, workers=1)
    return out


def test_every_pixel_shows_the_city_or_the_ground_around_it(folder: Path) -> None:
    scene = read_scene(folder)
    assert (len(scene.train), len(scene.test)) == (4, 1)
    for view in scene.views:
        image = view.photograph()
        assert image.std(axis=(0, 1)).min() > 0.02
        np.testing.assert_array_equal(image, view.photograph(background=1.0))  # opaque


def test_points_lie_in_the_streets_and_on_the_houses(folder: Path) -> None:
    points = read_scene(folder).points
    assert points is not None
    assert -0.1 < points.positions[:, 2].min() < 0.1 < points.positions[:, 2].max() < 2.5


@pytest.mark.parametrize("count", [40, 300])
def test_views_are_evenly_spaced_above_the_city(count: int) -> None:
    poses = np.array(City(train=count).poses()["train"])
    half = City().half
    down = poses[:, :3, 3] - poses[:, :3, 2] * (FLIGHT / poses[:, 2, 2])[:, None]  # where the axes meet the ground
    np.testing.assert_allclose(down[:, 2], 0, atol=1e-9)
    held = np.histogram2d(down[:, 0], down[:, 1], bins=4, range=[[-half, half]] * 2)[0]
    assert held.sum() == count
    assert held.min() >= 0.4 * count / 16
    tilts = np.degrees(np.arccos(poses[:, 2, 2]))
    assert 9.9 < tilts.min() < tilts.max() < 35.1


def test_replacing_a_different_city_is_refused(folder: Path) -> None:
    assert "already complete" in write_dataset(folder, TINY)
    for other in (City(size=16, train=4, test=1, lots=4), SyntheticOptions(size=16, train=4, test=1)):
        with pytest.raises(DataError, match="contains another dataset"):
            write_dataset(folder, other)
