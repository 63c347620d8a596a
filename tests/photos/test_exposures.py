"""Exposures of photographs, estimated from pixels that show the same points."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.photos.exposure_estimate import (
    UNKNOWN,
    Exposures,
    _fit,
    complete_exposures,
    measure_exposures,
    sample_points,
)
from clsplat.prepare.undistort import undistort_scene
from clsplat.scene.colmap import make_tracks, read_images, read_point_table
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.detect import read_scene
from clsplat.scene.images import CameraExposure, write_exposures
from clsplat.scene.scene import PointCloud
from clsplat.scene.view import View, load_image
from clsplat.training.modules.exposure import estimate_exposures
from tests.support.exposed_wall import POINTS, SIZE, Wall


def table(exposures: Exposures) -> np.ndarray:
    return np.array(list(exposures.log_gains.values()))


def test_gains_are_recovered(rng):
    wall = Wall(rng)
    result = wall.measured()
    assert table(result) == pytest.approx(wall.log_gains, abs=2e-3)
    assert result.spread == pytest.approx(np.std(wall.log_gains @ [0.299, 0.587, 0.114]), abs=2e-3)
    assert result.explained_variance > 0.95
    assert f"exposures of 8 photos differ by {result.spread:.1%} at 400 points" in result.summary


def test_exif_fills_in_for_photographs_without_tracks(rng):
    """Two of eight show too few points; cameras noted those, and two others, from another middle."""
    wall = Wall(rng)
    seen = {name: rows[:19] if name in ("2.png", "5.png") else rows for name, rows in wall.tracks.rows.items()}
    wall.tracks = replace(wall.tracks, rows=seen)
    shown = wall.measured()
    assert shown.log_gains.keys() == {f"{i}.png" for i in (0, 1, 3, 4, 6, 7)}
    truth = dict(zip(seen, wall.log_gains, strict=True))
    told = Exposures({name: truth[name] + 0.7 for name in ("0.png", "2.png", "3.png", "5.png")}, "as noted")
    result = complete_exposures(shown, told)
    assert result.log_gains.keys() == truth.keys()
    for name, gains in truth.items():
        assert result.log_gains[name] == pytest.approx(gains, abs=3e-3)
    assert table(result).mean(axis=0) == pytest.approx(0, abs=1e-12)
    assert result.summary.startswith("exposures of 8 photos differ by")
    assert result.summary.endswith(", those of 2 as noted")
    assert result.explained_variance == shown.explained_variance


class Photograph:
    """A photograph whose pixels all count."""

    def __init__(self, pixels: np.ndarray) -> None:
        self.pixels = pixels

    def image(self) -> np.ndarray:
        return self.pixels

    def unmasked_pixels(self) -> None:
        return None


def test_run_starts_from_tracks_and_exif(rng, tmp_path):
    wall = Wall(rng)
    wall.tracks = replace(wall.tracks, rows={**wall.tracks.rows, "2.png": np.arange(19)})
    wall.write(tmp_path)
    light = {view.name: float(np.exp(2.2 * wall.log_gains[i].mean())) for i, view in enumerate(wall.views)}
    write_exposures(tmp_path / "images", {name: CameraExposure(one, 1.0, 1.0) for name, one in light.items()})
    scene = read_scene(tmp_path, 0)
    run = SimpleNamespace(
        scene=scene,
        cache={},
        photographs=SimpleNamespace(get=lambda view: Photograph(load_image(view)[..., :3])),
        status=SimpleNamespace(counted=lambda views, *_: views),
    )
    result = estimate_exposures(run)
    assert result.summary.endswith("those of 1 according to EXIF")
    assert result.log_gains["2.png"].mean() == pytest.approx(wall.log_gains[2].mean(), abs=0.01)


def test_unusable_exif_leaves_the_gains_of_tracks(rng):
    shown = Wall(rng).measured()
    apart = Exposures({"other.png": np.zeros(3)}, "as noted")
    for message in (UNKNOWN, Exposures(dict(shown.log_gains), "as noted"), apart):
        assert complete_exposures(shown, message) is shown
    assert complete_exposures(Exposures({}, "at 0 points"), apart) is apart


@pytest.mark.parametrize("spread", [0.0, 0.25])
def test_images_that_differ_only_by_gains_are_accepted(rng, spread):
    """Nothing is left then but rounding, which says nothing."""
    wall = Wall(rng)
    log_gains = wall.log_gains[:, 0] * (spread / 0.25)
    photograph, point = (part.ravel() for part in np.indices((8, POINTS)))
    values = wall.colors[point, 0] * np.exp(log_gains[photograph])
    assert _fit(photograph, point, values, 8)[0] == pytest.approx(log_gains - log_gains.mean(), abs=1e-6)


def test_images_linked_by_a_chain_of_points_are_compared(rng):
    wall = Wall(rng, photographs=20, overlap=60)
    assert table(wall.measured()) == pytest.approx(wall.log_gains, abs=0.01)


def test_third_of_the_points_may_be_hidden(rng):
    wall = Wall(rng)
    whole = wall.photograph

    def partly(view: View) -> np.ndarray:
        image = whole(view)
        image[rng.random((SIZE // 4, SIZE // 4)).repeat(4, 0).repeat(4, 1) < 0.2] = 90
        return image

    wall.photograph = partly
    assert table(wall.measured()) == pytest.approx(wall.log_gains, abs=0.06)


def test_view_dependent_light_is_not_exposure(rng):
    """Each photograph of a point differs independently."""
    wall = Wall(rng)
    wall.log_gains[:] = 0
    colors = wall.colors
    glossy = {view.name: colors * np.exp(rng.normal(0, 0.3, (POINTS, 1))) for view in wall.views}

    def photograph(view: View) -> np.ndarray:
        wall.colors = glossy[view.name]
        return Wall.photograph(wall, view)

    exposures = measure_exposures(wall.tracks, wall.views, lambda view: (photograph(view), None))
    assert exposures.explained_variance < 0.1
    assert exposures.spread < 0.05


def test_undetermined_gains_are_omitted(rng):
    wall = Wall(rng)
    seen = {**wall.tracks.rows, "3.png": np.empty(0, np.int64)}
    wall.tracks = replace(wall.tracks, rows=seen)
    assert wall.measured().log_gains.keys() == {view.name for view in wall.views} - {"3.png"}
    nothing = measure_exposures(replace(wall.tracks, rows={}), wall.views, lambda view: (wall.photograph(view), None))
    assert nothing.log_gains == {}
    assert nothing.spread == 0


def test_points_count_at_their_observations(rng):
    wall, view = Wall(rng), Wall(rng).views[0]
    image, mask = wall.photograph(wall.views[0]), np.zeros((SIZE, SIZE), bool)
    rows, values = sample_points(wall.tracks, view, image, None)
    assert (rows == np.arange(POINTS)).all()
    assert values == pytest.approx(wall.colors * np.exp(wall.log_gains[0]), abs=3e-3)
    mask[:, : SIZE // 2] = True
    assert len(sample_points(wall.tracks, view, image, mask)[0]) == pytest.approx(POINTS / 2, abs=20)
    behind = replace(wall.tracks, positions=-wall.tracks.positions)
    assert len(sample_points(behind, view, image, None)[0]) == 0


def test_tracks_are_written_and_read(rng, tmp_path):
    wall = Wall(rng, overlap=60)
    points = PointCloud(wall.tracks.positions.astype(np.float32), wall.colors.astype(np.float32))
    write_model(tmp_path, wall.views, points, wall.tracks)
    images, read = read_images(tmp_path), read_point_table(tmp_path)
    tracks = make_tracks(images, read)
    assert tracks.positions == pytest.approx(wall.tracks.positions)
    assert {name: rows.tolist() for name, rows in tracks.rows.items()} == {
        name: rows.tolist() for name, rows in wall.tracks.rows.items()
    }
    assert [len(image.points) for image in images] == [60] * len(images)
    write_model(tmp_path, wall.views, points)
    assert make_tracks(read_images(tmp_path), read_point_table(tmp_path)) is None


def test_text_tracks_follow_point_ids(tmp_path):
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n1 1 7 2 2 -1 3 3 5 4 4 5 9 9 77\n")
    (tmp_path / "points3D.txt").write_text("7 0 0 1 9 9 9 0.5 1 0\n5 1 0 1 9 9 9 0.5 1 2\n")
    tracks = make_tracks(read_images(tmp_path), read_point_table(tmp_path))
    assert tracks.rows["a.png"].tolist() == [1, 0], "by id; 77 is no point"


def test_undistorted_scenes_keep_tracks(rng, tmp_path):
    wall = Wall(rng, photographs=3)
    wall.write(tmp_path / "scene")
    assert undistort_scene(tmp_path / "scene", tmp_path / "out", long_side=32) == 3
    scene = read_scene(tmp_path / "out", holdout=0)
    exposures = measure_exposures(scene.tracks, scene.views, lambda view: (load_image(view), None))
    assert scene.views[0].camera.width == 32
    assert table(exposures) == pytest.approx(wall.log_gains, abs=0.1), "squares of 1.5 px"
