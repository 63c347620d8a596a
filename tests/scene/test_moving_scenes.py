"""Moving scenes: the ray-cast scene, readers of times, and refusals."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.data_tools.synthetic import write_dataset
from clsplat.prepare.inspect.findings import Inspection, summarize
from clsplat.prepare.undistort import undistort_scene
from clsplat.scene.camera_files import write_cameras
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import decode_all, require_decodable
from clsplat.scene.points import read_points_ply, write_points_ply
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.times import Clock, distinct_times, group_by_camera
from clsplat.scene.times_file import write_times
from tests.support.moving_scene import STATIC_SHAPES, Moving, shapes_at
from tests.support.refusals import refusal
from tests.support.transforms_scene import LENS, frames, several_cameras, write

SMALL = Moving(size=24, train=2, test=1, times=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("moving") / "scene"
    write_dataset(out, SMALL, workers=1)
    return out


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return read_scene(folder)


@pytest.fixture(scope="module")
def tiny_colmap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cameras as COLMAP has them."""
    folder, out = tmp_path_factory.mktemp("tiny"), tmp_path_factory.mktemp("colmap") / "scene"
    undistort_scene(write(folder / "a", **LENS, frames=frames("a.png", "b.png", "c.png")), out)
    points = PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.float32))
    write_model(out / "sparse" / "0", list(read_scene(out, 0).views), points, None)
    return out


def test_training_views_share_no_held_out_camera_or_time(scene):
    train, test = (scene.split(name) for name in ("train", "test"))
    assert (len(train), len(test)) == (2 * 5, 6)
    assert distinct_times(train) == pytest.approx([0, 0.2, 0.6, 0.8, 1])
    assert distinct_times(test) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert not {view.world_to_camera.tobytes() for view in train} & {view.world_to_camera.tobytes() for view in test}
    assert [len(group) for group in group_by_camera(scene.views)] == [5, 5, 6]


def test_photographs_are_equal_in_static_pixels_only(folder, scene):
    test = scene.split("test")
    still = cv2.imread(str(test[0].static_path), cv2.IMREAD_UNCHANGED)[..., 0] == 255
    images = np.stack([cv2.imread(str(view.image_path), cv2.IMREAD_UNCHANGED) for view in test])
    assert 0.05 < still.mean() < 0.6
    assert (images[:, still] == images[0, still]).all()
    assert (images[0, still, 3] == 255).all(), "the background does not count"
    assert (np.ptp(images[:, ~still], axis=0).max(axis=1) > 0).sum() > 20


def test_static_parts_never_change_and_three_things_do():
    first, last = shapes_at(0.0), shapes_at(0.8)
    assert first[: len(STATIC_SHAPES)] == last[: len(STATIC_SHAPES)] == STATIC_SHAPES
    ball, book, lamp = (first[-3:][i] for i in range(3))
    assert ball.center != last[-3].center
    assert book.yaw != last[-2].yaw
    p = np.array([[0.1], [0.05], [0.03]])
    assert not np.allclose(lamp.paint(p), last[-1].paint(p))


def test_points_have_their_observation_time(scene):
    points = scene.points
    assert points is not None
    assert points.times is not None
    assert set(points.times) == {np.float32(time) for time in distinct_times(scene.split("train"))}
    red = (points.colors[:, 0] > 0.5) & (points.colors[:, 1:].max(axis=1) < 0.25) & (points.positions[:, 2] > 0.03)
    ball = red & (points.positions[:, 1] < -0.2)
    assert ball.sum() > 5
    way = np.array([shapes_at(float(time))[-3].center for time in points.times[ball]])
    assert np.median(np.linalg.norm(points.positions[ball] - way, axis=1)) == pytest.approx(0.13, abs=0.02)


def test_folder_is_reproducible(folder, tmp_path):
    write_dataset(tmp_path / "again", SMALL, workers=1)
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert len(files) == 10 + 6 + 1 + 4
    assert all((folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes() for name in files)
    assert "already complete" in write_dataset(folder, SMALL)


def test_inspect_reports_timestamps_and_cameras(folder):
    inspection = Inspection.from_folder(folder)
    assert summarize(inspection.facts)["times"] == "6 timestamps from 3 cameras"
    assert not inspection.facts.same_pose
    assert inspection.is_trainable


def timed(*times: float, **values: object) -> list[dict]:
    names = [f"{i:02}.png" for i in range(len(times))]
    return [frame | {"time": time} for frame, time in zip(frames(*names, **values), times, strict=True)]


def test_times_of_any_unit_are_normalized(tmp_path):
    path = write(tmp_path / "a", **LENS, frames=timed(30, 10, 20))
    assert [view.time for view in read_scene(path, 0).views] == [1, 0, 0.5]


def test_blender_scene_has_one_clock_for_both_files(tmp_path):
    train = write(tmp_path / "a", "transforms_train.json", camera_angle_x=0.7, frames=timed(0.25, 0.5))
    write(train, "transforms_test.json", camera_angle_x=0.7, frames=[timed(0.75)[0] | {"file_path": "t.png"}])
    assert [view.time for view in read_scene(train).views] == [0, 0.5, 1]


def test_scene_without_times_is_static(tmp_path):
    path = write(tmp_path / "a", **LENS, frames=frames("0.png", "1.png"))
    assert [view.time for view in read_scene(path).views] == [None, None]
    assert "times" not in summarize(Inspection.from_folder(path).facts)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, None, 1], "1 of 3 frames have no `time`: .*frames[1]; add the missing times"),
        ([2, 2, 2], "all 3 frames have the time 2; expected at least two times"),
        ([0, float("nan"), 1], "frames[1]: time is nan; expected a number between -1e+15 and 1e+15"),
        ([0, "one", 2], "frames[1]: time is 'one'; expected a number between"),
        ([-1e300, 1e300, 0], "frames[0]: time is -1e+300; expected a number between"),
        ([0, 10**17, 1e17], "frames[1]: time is 100000000000000000; expected a number between -1e+15 and 1e+15"),
    ],
)
def test_invalid_times_are_refused_with_their_location(tmp_path, times, message):
    table = timed(*times)
    for frame in table:
        if frame["time"] is None:
            del frame["time"]
    path = write(tmp_path / "a", **LENS, frames=table)
    fault = refusal(read_scene, path)
    assert all(part in fault for part in message.split(".*")), fault
    inspection = Inspection.from_folder(path)
    assert not inspection.is_trainable
    assert any(message.split(".*")[-1] in finding.text for finding in inspection.findings)


def test_missing_static_mask_is_refused(tmp_path):
    table = timed(0, 1)
    table[1]["static_path"] = "still.png"
    assert "still.png" in refusal(read_scene, write(tmp_path / "a", **LENS, frames=table))


def test_times_of_points_are_written_and_read(tmp_path):
    points = PointCloud(np.eye(3, dtype=np.float32), np.full((3, 3), 0.2, np.float32), np.float32([0, 0.5, 1]))
    write_points_ply(tmp_path / "p.ply", points)
    times = read_points_ply(tmp_path / "p.ply", Clock(0, 2)).times
    assert times is not None
    assert times.tolist() == [0, 0.25, 0.5]
    assert read_points_ply(tmp_path / "p.ply").times is None, "a scene that does not move has no clock"
    assert points.joined(points).times.tolist() == [0, 0.5, 1] * 2
    assert points.joined(PointCloud(points.positions, points.colors)).times is None


def test_times_of_points_in_another_unit_are_refused(tmp_path):
    path = write(tmp_path / "a", **LENS, frames=timed(10, 20, 30))
    seen = PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.float32), np.float32([10, 20, 30]))
    write_points_ply(path / "points3d.ply", seen)
    assert read_scene(path).points.times.tolist() == [0, 0.5, 1]
    write_points_ply(path / "points3d.ply", replace(seen, times=np.float32([0, 0.5, 1])))
    fault = refusal(read_scene, path)
    assert "points3d.ply: its points have times from 0 to 1, but the frames" in fault
    assert "10 to 30" in fault
    assert fault in [finding.text for finding in Inspection.from_folder(path).findings]


def test_damaged_static_mask_is_refused_before_training(tmp_path):
    table = timed(0, 1, 2)
    for frame in table:
        frame["static_path"] = "still.png"
    path = write(tmp_path / "a", **LENS, frames=table)
    cv2.imwrite(str(path / "still.png"), np.zeros((5, 7), np.uint8))
    with pytest.raises(DataError, match=r"1 of 4 image files cannot be used: .*still.png"):
        require_decodable(path, decode_all(read_scene(path).views))
    assert any("static mask" in finding.text for finding in Inspection.from_folder(path).findings)


def test_folder_of_frames_per_camera_is_a_moving_scene(tmp_path):
    folder = several_cameras(tmp_path, {"left": 3, "right": 3})
    (folder / "static").mkdir()
    cv2.imwrite(str(folder / "static" / "left.png"), np.full((48, 64), 255, np.uint8))
    scene = read_scene(folder, 2)
    assert [(view.name, view.time) for view in scene.split("train")] == [
        ("right/0000.png", 0.0),
        ("right/0001.png", 0.5),
        ("right/0002.png", 1.0),
    ]
    assert [view.static_path for view in scene.split("test")] == [folder / "static" / "left.png"] * 3
    assert summarize(Inspection.from_folder(folder).facts)["times"] == "3 timestamps from 2 cameras"
    assert len(group_by_camera(scene.views)) == 2


def test_frames_are_sorted_by_number(tmp_path):
    folder = several_cameras(tmp_path, {"a": 3})
    for old, new in (("0000", "9"), ("0001", "10"), ("0002", "100")):
        (folder / "videos" / "a" / f"{old}.png").rename(folder / "videos" / "a" / f"{new}.png")
    assert [view.name for view in read_scene(folder, 0).views] == ["a/9.png", "a/10.png", "a/100.png"]


def test_videos_can_use_colmap_cameras(tiny_colmap, tmp_path):
    scene = read_scene(tiny_colmap, 0)
    for view in scene.views[:2]:
        folder = tmp_path / "videos" / Path(view.name).stem
        folder.mkdir(parents=True)
        for i in range(2):
            (folder / f"{i}.png").write_bytes(view.image_path.read_bytes())
    (tmp_path / "sparse").symlink_to(tiny_colmap / "sparse")
    moving = read_scene(tmp_path, 0)
    assert [view.time for view in moving.views] == [0, 1, 0, 1]
    assert moving.views[0].camera == scene.views[0].camera
    assert moving.points is not None


@pytest.mark.parametrize(
    ("counts", "posed", "message"),
    [
        ({"a": 3, "b": 2}, (), "b has 2 frames, a has 3; expected the same number of frames from every camera"),
        ({"a": 1, "b": 1}, (), "has one frame per camera; expected at least two"),
        ({"a": 2, "b": 2}, ("a",), "1 of 2 cameras have no pose: b"),
        ({"a": 2}, ("a", "x/a"), "images/a.png and images/x/a.png are both poses of camera a"),
        ({"a": 0}, ("a",), "has no folders of frames"),
        ({"a": 2, "b": 0}, (), "1 of 2 cameras have no frames: b"),
    ],
)
def test_videos_of_the_wrong_size_are_refused(tmp_path, counts, posed, message):
    (tmp_path / "videos").mkdir()
    assert message in refusal(read_scene, several_cameras(tmp_path, counts, *posed))


def test_video_without_a_matching_camera_is_ignored(tmp_path):
    several_cameras(tmp_path, {}, "0001", "0002")
    (tmp_path / "images").mkdir()
    for name in ("0001", "0002"):
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "videos").mkdir()
    for clip in (None, "clip.mp4"):
        if clip:
            (tmp_path / "videos" / clip).write_bytes(b"a video")
        assert [view.time for view in read_scene(tmp_path, 0).views] == [None, None]
    (tmp_path / "videos" / "0002.mp4").write_bytes(b"a video")
    frames = tmp_path / "videos" / "0002"
    assert f"`ffmpeg -i {frames}.mp4 -r 10 {frames}/%04d.png`" in refusal(read_scene, tmp_path)


def test_colmap_folder_with_times_is_dynamic(tiny_colmap, tmp_path):
    shutil.copytree(tiny_colmap, tmp_path / "scene")
    names = [view.name for view in read_scene(tiny_colmap, 0).views]
    write_times(tmp_path / "scene" / "images", {name: 5 + i for i, name in enumerate(names)})
    times = [view.time for view in read_scene(tmp_path / "scene", 0).views]
    assert times == pytest.approx(np.linspace(0, 1, len(names)))
    undistort_scene(tmp_path / "scene", tmp_path / "pinhole")
    assert [view.time for view in read_scene(tmp_path / "pinhole", 0).views] == pytest.approx(times)
    path = tmp_path / "scene" / "images" / "times.json"
    path.unlink()
    path.symlink_to("nowhere.json")
    assert "times.json" in refusal(read_scene, tmp_path / "scene"), "what is there is read, or refused"
    path.unlink()
    write_times(tmp_path / "scene" / "images", {name: 1e17 + 32 * i for i, name in enumerate(names)})
    assert "is 1e+17; expected a number between -1e+15 and 1e+15" in refusal(read_scene, tmp_path / "scene")
    write_times(tmp_path / "scene" / "images", {name: 5.0 for name in names[1:]})
    assert f"1 of {len(names)} frames have no `time`: {names[0]}" in refusal(read_scene, tmp_path / "scene")


def test_cameras_for_nerfstudio_keep_times(scene, tmp_path):
    write_cameras(scene, tmp_path / "out", "nerfstudio", "copy")
    again = {view.name: view.time for view in read_scene(tmp_path / "out").views}
    assert again == pytest.approx({f"images/{view.name}.png": view.time for view in scene.views})
