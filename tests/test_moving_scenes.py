"""Scenes that move: the ray-cast one, the readers of times, and what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.inspect.figures import figures
from clsplat.inspect.inspection import Inspection
from clsplat.scene.detect import read_scene
from clsplat.scene.points import read_points_ply, write_points_ply
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.times import by_camera, moments_of
from data_tools.moving import STANDING, Moving, shapes_at
from data_tools.synthetic import write_dataset
from tests.refusals import refusal
from tests.test_transforms import LENS, frames, write

SMALL = Moving(size=24, train=2, test=1, times=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("moving") / "scene"
    write_dataset(out, SMALL, workers=1)
    return out


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return read_scene(folder)


def test_no_training_view_has_a_camera_or_a_moment_of_those_held_out(scene):
    train, test = (scene.split(name) for name in ("train", "test"))
    assert (len(train), len(test)) == (2 * 5, 6)
    assert moments_of(train) == pytest.approx([0, 0.2, 0.6, 0.8, 1])
    assert moments_of(test) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert not {view.world_to_camera.tobytes() for view in train} & {view.world_to_camera.tobytes() for view in test}
    assert [len(group) for group in by_camera(scene.views)] == [5, 5, 6]


def test_photographs_are_equal_in_static_pixels_and_differ_in_others(folder, scene):
    test = scene.split("test")
    still = cv2.imread(str(test[0].static_path), cv2.IMREAD_UNCHANGED)[..., 0] == 255
    images = np.stack([cv2.imread(str(view.image_path), cv2.IMREAD_UNCHANGED) for view in test])
    assert 0.05 < still.mean() < 0.6
    assert (images[:, still] == images[0, still]).all()
    assert (images[0, still, 3] == 255).all(), "the background does not count"
    assert (np.ptp(images[:, ~still], axis=0).max(axis=1) > 0).sum() > 20


def test_what_stands_is_the_same_at_every_moment_and_three_things_change():
    first, last = shapes_at(0.0), shapes_at(0.8)
    assert first[: len(STANDING)] == last[: len(STANDING)] == STANDING
    ball, book, lamp = (first[-3:][i] for i in range(3))
    assert ball.centre != last[-3].centre
    assert book.yaw != last[-2].yaw
    p = np.array([[0.1], [0.05], [0.03]])
    assert not np.allclose(lamp.paint(p), last[-1].paint(p))


def test_points_have_the_moment_at_which_they_were_seen(scene):
    points = scene.points
    assert points is not None
    assert points.times is not None
    assert set(points.times) == {np.float32(time) for time in moments_of(scene.split("train"))}
    red = (points.colours[:, 0] > 0.5) & (points.colours[:, 1:].max(axis=1) < 0.25) & (points.positions[:, 2] > 0.03)
    ball = red & (points.positions[:, 1] < -0.2)
    assert ball.sum() > 5
    way = np.array([shapes_at(float(time))[-3].centre for time in points.times[ball]])
    assert np.median(np.linalg.norm(points.positions[ball] - way, axis=1)) == pytest.approx(0.13, abs=0.02)


def test_the_folder_is_the_same_each_time(folder, tmp_path):
    write_dataset(tmp_path / "again", SMALL, workers=2)
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert len(files) == 10 + 6 + 1 + 4
    assert all((folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes() for name in files)
    assert "complete already" in write_dataset(folder, SMALL)


def test_inspect_tells_the_moments_and_the_places(folder):
    found = Inspection.of(folder)
    assert figures(found.facts)["times"] == "6 moments, seen from 3 places"
    assert not found.facts.same_pose
    assert found.trainable


def timed(*times: float, **values: object) -> list[dict]:
    names = [f"{i:02}.png" for i in range(len(times))]
    return [frame | {"time": time} for frame, time in zip(frames(*names, **values), times, strict=True)]


def test_times_of_any_unit_become_those_of_the_scene(tmp_path):
    path = write(tmp_path / "a", **LENS, frames=timed(30, 10, 20))
    assert [view.time for view in read_scene(path, 0).views] == [1, 0, 0.5]


def test_a_blender_scene_has_one_clock_for_both_files(tmp_path):
    train = write(tmp_path / "a", "transforms_train.json", camera_angle_x=0.7, frames=timed(0.25, 0.5))
    write(train, "transforms_test.json", camera_angle_x=0.7, frames=[timed(0.75)[0] | {"file_path": "t.png"}])
    assert [view.time for view in read_scene(train).views] == [0, 0.5, 1]


def test_a_scene_without_times_does_not_move(tmp_path):
    path = write(tmp_path / "a", **LENS, frames=frames("0.png", "1.png"))
    assert [view.time for view in read_scene(path).views] == [None, None]
    assert "times" not in figures(Inspection.of(path).facts)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, None, 1], "1 of 3 frames have no `time`: .*frames[1]; expected a time in every frame, or in none"),
        ([2, 2, 2], "all 3 frames have the time 2; expected two moments at least"),
        ([0, float("nan"), 1], "frames[1]: time is nan; expected a finite number"),
        ([0, "1", 2], "frames[1]: time is '1'; expected a finite number"),
        ([-1e300, 1e300, 0], "frames[0]: time is -1e+300; expected a finite number"),
    ],
)
def test_wrong_times_are_refused_with_their_place(tmp_path, times, message):
    table = timed(*times)
    for frame in table:
        if frame["time"] is None:
            del frame["time"]
    path = write(tmp_path / "a", **LENS, frames=table)
    fault = refusal(read_scene, path)
    assert all(part in fault for part in message.split(".*")), fault
    found = Inspection.of(path)
    assert not found.trainable
    assert any(message.split(".*")[-1] in finding.text for finding in found.findings)


def test_a_mask_of_what_is_static_must_be_there(tmp_path):
    table = timed(0, 1)
    table[1]["static_path"] = "still.png"
    assert "still.png" in refusal(read_scene, write(tmp_path / "a", **LENS, frames=table))


def test_times_of_points_are_written_and_read(tmp_path):
    points = PointCloud(np.eye(3, dtype=np.float32), np.full((3, 3), 0.2, np.float32), np.float32([0, 0.5, 1]))
    write_points_ply(tmp_path / "p.ply", points)
    times = read_points_ply(tmp_path / "p.ply", lambda values: values / 2).times
    assert times is not None
    assert times.tolist() == [0, 0.25, 0.5]
    assert read_points_ply(tmp_path / "p.ply").times is None, "a scene that does not move has no clock"
    assert points.joined(points).times.tolist() == [0, 0.5, 1] * 2
    assert points.joined(PointCloud(points.positions, points.colours)).times is None
