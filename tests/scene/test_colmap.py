"""The reader of COLMAP folders against pycolmap, on real data, and against a writer."""

import logging
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from clsplat.core.errors import DataError
from clsplat.scene.camera import Camera
from clsplat.scene.colmap import MODELS, PARAMETERS, read_cameras, read_images, read_point_table
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.scene.view import load_image
from tests.support.colmap_writer import (
    PINHOLE,
    ColmapModel,
    ImageEntry,
    PointEntry,
    models,
    tiny_model,
    write_model,
    write_scene,
)
from tests.support.data_sets import data_set

SCENES = ["fox", "fox_peers", "kitchen", "lund", "brighton"]
STATUES = [f"colmap_models/statue_{model}" for model in ("PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")]


# ---- what pycolmap reads


def assert_same_images(folder: Path, reconstruction) -> None:
    images = read_images(folder)
    cameras = read_cameras(folder)
    assert len(images) == reconstruction.num_reg_images() > 0
    expected = {image.name: image for image in reconstruction.images.values()}
    for image in images:
        pose = expected[image.name].cam_from_world()
        np.testing.assert_allclose(image.translation, pose.translation, rtol=0, atol=1e-12)
        x, y, z, w = pose.rotation.quat
        np.testing.assert_allclose(image.quaternion, (w, x, y, z), rtol=0, atol=1e-12)
        camera, theirs = cameras[image.camera], reconstruction.cameras[expected[image.name].camera_id]
        assert (camera.model, camera.width, camera.height) == (theirs.model.name, theirs.width, theirs.height)
        np.testing.assert_array_equal(camera.params, theirs.params)


def assert_same_points(folder: Path, reconstruction) -> None:
    points = read_point_table(folder).to_point_cloud()
    assert points is not None
    assert points.colors.dtype == np.float32
    theirs = reconstruction.points3D.values()
    expected = np.array([[*np.float32(p.xyz), *(np.float32(p.color) / np.float32(255))] for p in theirs], np.float32)
    ours = np.concatenate([np.float32(points.positions), points.colors], axis=1)
    np.testing.assert_array_equal(ours[np.lexsort(ours.T)], expected[np.lexsort(expected.T)])


@pytest.mark.parametrize("name", SCENES)
def test_real_scene_matches_pycolmap(name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    path = data_set(name)
    scene = read_scene(path)
    reconstruction = pycolmap.Reconstruction(path / "sparse" / "0")
    theirs = {image.name: image for image in reconstruction.images.values()}
    assert [view.name for view in scene.views] == sorted(theirs)
    for view in scene.views:
        image = theirs[view.name]
        np.testing.assert_allclose(view.world_to_camera, image.cam_from_world().matrix(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(view.position, image.projection_center(), rtol=0, atol=1e-11)
        camera = reconstruction.cameras[image.camera_id]
        assert view.camera == Camera(camera.width, camera.height, *camera.params)
        assert view.image_path.is_file()
    assert scene.test == tuple(range(0, len(scene.views), 8))
    assert scene.extent > 0
    assert_same_points(path / "sparse" / "0", reconstruction)


@pytest.mark.parametrize(("name", "kind"), [(name, ("bin", "txt")[i % 2]) for i, name in enumerate(STATUES)])
def test_every_camera_model_matches_pycolmap(name: str, kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = data_set(name) / ("text" if kind == "txt" else ".")
    reconstruction = pycolmap.Reconstruction(folder)
    assert_same_images(folder, reconstruction)
    assert_same_points(folder, reconstruction)


def test_distorted_real_photographs_are_undistorted() -> None:
    scene, undistorted = read_scene(data_set("fox_opencv")), read_scene(data_set("fox"))
    assert all(view.lens and view.lens.model == "OPENCV" for view in scene.views)
    view = scene.views[3]
    assert load_image(view).shape == (view.camera.height, view.camera.width, 3)
    assert abs(view.camera.width - undistorted.views[3].camera.width) < 20


def test_every_camera_model_is_known() -> None:
    pycolmap = pytest.importorskip("pycolmap", minversion="4")
    known = {int(number): name for name, number in pycolmap.CameraModelId.__members__.items() if int(number) >= 0}
    assert [known[number] for number in sorted(known)][: len(MODELS)] == MODELS
    for name, count in PARAMETERS.items():
        assert len(pycolmap.Camera.create_from_model_name(1, name, 50.0, 64, 48).params) == count, name


def test_pose_of_a_rig_is_composed(tmp_path: Path) -> None:
    """The reader ignores rigs.bin and frames.bin: images.bin must hold what they say together."""
    pycolmap = pytest.importorskip("pycolmap", minversion="3.12")
    reconstruction = pycolmap.Reconstruction()
    cameras = [pycolmap.Camera.create_from_model_name(i, "PINHOLE", 100.0, 64, 48) for i in (1, 2)]
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(cameras[0].sensor_id)
    rig.add_sensor(cameras[1].sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d([0.1, 0.2, 0.3, 0.9]), [1, 2, 3]))
    world = pycolmap.Rigid3d(pycolmap.Rotation3d([0.3, -0.2, 0.1, 0.8]), [-1, 0.5, 2])
    frame = pycolmap.Frame(frame_id=1, rig_id=1, rig_from_world=world)
    images = [pycolmap.Image(name=f"{i}.jpg", camera_id=i, image_id=i, frame_id=1) for i in (1, 2)]
    for image in images:
        frame.add_data_id(image.data_id)
    for add, things in ((reconstruction.add_camera, cameras), (reconstruction.add_rig, [rig])):
        for thing in things:
            add(thing)
    reconstruction.add_frame(frame)
    for image in images:
        reconstruction.add_image(image)
    reconstruction.register_frame(1)
    reconstruction.write(tmp_path)
    assert (tmp_path / "rigs.bin").exists()
    assert_same_images(tmp_path, reconstruction)
    assert max(image.translation[2] for image in read_images(tmp_path)) == pytest.approx(5.25)


# ---- what the writer wrote


def rotated(quaternion: tuple[float, ...], vector: np.ndarray) -> np.ndarray:
    """Rotate a vector [3] by a quaternion: v + 2 u x (u x v + w v), not by way of a matrix."""
    w, *u = np.array(quaternion) / math.hypot(*quaternion)
    return vector + 2 * np.cross(u, np.cross(u, vector) + w * vector)


def assert_matches(scene: Scene, model: ColmapModel) -> None:
    images = {image.name: image for image in model.images}
    cameras = {camera.number: camera for camera in model.cameras}
    assert [view.name for view in scene.views] == sorted(images)
    for view in scene.views:
        image, camera = images[view.name], cameras[images[view.name].camera]
        single = camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        focals = [camera.params[0]] * 2 if single else list(camera.params[:2])
        center = camera.params[1:3] if single else camera.params[2:4]
        assert view.camera == Camera(camera.width, camera.height, *focals, *center)
        for axis in np.eye(3):
            np.testing.assert_allclose(view.world_to_camera[:, :3] @ axis, rotated(image.quaternion, axis), atol=1e-12)
        np.testing.assert_array_equal(view.world_to_camera[:, 3], image.translation)
        assert view.image_path == scene.path / "images" / view.name
    if not model.points:
        assert scene.points is None
        return
    assert scene.points is not None
    np.testing.assert_array_equal(scene.points.positions, np.float32([p.position for p in model.points]))
    np.testing.assert_allclose(scene.points.colors * 255, [p.rgb for p in model.points], atol=1e-4)


@pytest.mark.parametrize("kind", ["bin", "txt"])
@given(model=models())
@settings(max_examples=60, deadline=None)
def test_written_model_is_read_back(tmp_path_factory: pytest.TempPathFactory, kind: str, model: ColmapModel) -> None:
    path = write_scene(tmp_path_factory.mktemp("scene"), model, kind)
    assert_matches(read_scene(path), model)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_pycolmap_reads_written_models(tmp_path: Path, kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = replace(tiny_model(), points=[replace(point, track=0) for point in tiny_model().points])
    write_model(tmp_path, replace(model, images=[replace(image, points2d=0) for image in model.images]), kind)
    reconstruction = pycolmap.Reconstruction(tmp_path)
    image = next(image for image in reconstruction.images.values() if image.name == "b.jpg")
    expected = np.column_stack([np.array([rotated((1, 1, -1, 1), axis) for axis in np.eye(3)]).T, (1, 2, 3)])
    np.testing.assert_allclose(image.cam_from_world().matrix(), expected, atol=1e-12)
    assert sorted(tuple(point.xyz) for point in reconstruction.points3D.values())[2] == (7, 8, 9)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_model_is_found_in_three_folders(tmp_path: Path, place: str) -> None:
    write_scene(tmp_path, tiny_model())
    model = tmp_path / "sparse" / "0"
    for file in sorted(model.iterdir()):
        file.rename(tmp_path / place / file.name)
    assert_matches(read_scene(tmp_path), tiny_model())


@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_model_folder_itself_may_be_named(tmp_path: Path, place: str) -> None:
    path = write_model(tmp_path / place, tiny_model())
    write_scene(tmp_path / "other", tiny_model())
    (tmp_path / "other" / "images").rename(tmp_path / "images")
    assert read_scene(path).views[0].image_path == tmp_path / "images" / "a.jpg"


def test_largest_model_is_used_and_others_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_scene(tmp_path, replace(tiny_model(), images=tiny_model().images[:2]))
    write_scene(tmp_path / "one", tiny_model())
    (tmp_path / "one" / "sparse" / "0").rename(tmp_path / "sparse" / "1")
    (tmp_path / "images" / "c.jpg").touch()
    with caplog.at_level(logging.INFO, "clsplat"):
        assert len(read_scene(tmp_path).views) == 3
    assert "sparse/1: using the largest model, with 3 images" in caplog.text
    assert "sparse/0 (2)" in caplog.text


def test_binary_is_preferred_to_text(tmp_path: Path) -> None:
    write_scene(tmp_path, tiny_model(), "bin")
    write_scene(tmp_path, replace(tiny_model(), images=[ImageEntry("text.jpg")]), "txt")
    assert [view.name for view in read_scene(tmp_path).views] == ["a.jpg", "b.jpg", "c.jpg"]


@pytest.mark.parametrize("holdout", [0, 2, 8])
def test_every_nth_view_by_name_is_for_testing(tmp_path: Path, holdout: int) -> None:
    model = ColmapModel([PINHOLE], [ImageEntry(f"{i:02}.jpg") for i in reversed(range(17))])
    scene = read_scene(write_scene(tmp_path, model), holdout)
    expected = {0: [], 2: list(range(0, 17, 2)), 8: [0, 8, 16]}[holdout]
    assert [view.name for view in scene.split("test")] == [f"{i:02}.jpg" for i in expected]
    assert len(scene.train) + len(scene.test) == 17


def test_same_file_name_in_two_folders_makes_two_views(tmp_path: Path) -> None:
    model = ColmapModel([PINHOLE], [ImageEntry("b/1.jpg"), ImageEntry("a/1.jpg", translation=(1, 0, 0))])
    assert [view.name for view in read_scene(write_scene(tmp_path, model)).views] == ["a/1.jpg", "b/1.jpg"]


def test_points_may_be_missing(tmp_path: Path) -> None:
    write_scene(tmp_path, tiny_model())
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    assert read_scene(tmp_path).points is None


@pytest.mark.parametrize("stem", ["cameras", "images"])
def test_missing_file_of_a_model_is_named(tmp_path: Path, stem: str) -> None:
    write_scene(tmp_path, tiny_model())
    (tmp_path / "sparse" / "0" / f"{stem}.bin").unlink()
    with pytest.raises(DataError, match=rf"sparse/0: no {stem}\.bin or {stem}\.txt"):
        read_scene(tmp_path)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_nonfinite_points_are_dropped(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    positions = [(1.0, math.nan, 3.0), (1.0, 2.0, 3.0), (math.inf, 0.0, 0.0), (1e300, 0.0, 0.0)]
    model = replace(tiny_model(), points=[PointEntry(position) for position in positions])
    points = read_scene(write_scene(tmp_path, model, kind)).points
    assert points is not None
    np.testing.assert_array_equal(points.positions, [[1, 2, 3]])
    assert "dropped 3 points" in caplog.text


def test_hundred_thousand_points_are_read(tmp_path: Path) -> None:
    row = struct.pack("<Q3d3BdQ", 1, 1.0, 2.0, 3.0, 10, 20, 30, 0.5, 3) + struct.pack("<6I", *range(6))
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 100_000) + row * 100_000)
    points = read_point_table(tmp_path).to_point_cloud()
    assert points is not None
    assert len(points) == 100_000
