"""Cameras written for other programs: round trips of poses, lenses, distortion, points, and the split."""

import json
import logging
import shutil
import struct
from dataclasses import replace
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat import cli
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.quaternions import rotation_matrix
from clsplat.scene import camera_files
from clsplat.scene.camera import MODELS, Lens
from clsplat.scene.camera_files import DISTORTION
from clsplat.scene.colmap import read_cameras, read_images
from clsplat.scene.images import CameraExposure, write_exposures
from clsplat.scene.reprojection import replace_cameras
from clsplat.scene.scene import PointCloud, Tracks, make_scene
from clsplat.scene.view import View, load_exposures
from clsplat.stages.export import Cameras
from tests.support.commands import clsplat as command
from tests.support.data_sets import data_set

LENSES = {  # parameters after the focal lengths and the middle
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0.05,),
    "RADIAL": (0.05, -0.02),
    "OPENCV": (0.05, -0.02, 1e-3, -2e-3),
    "FULL_OPENCV": (0.05, -0.02, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.003, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (0.02,),
    "RADIAL_FISHEYE": (0.02, -0.01),
    "FOV": (0.4,),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 1e-3, -2e-3, 0.001, 0.002, 1e-3, 2e-3),
}
SIZE = 60, 40


def make_lens(model, i=0):
    focals = (61.25 + i / 7, 63.5)[: MODELS[model][0]]
    return Lens(*SIZE, model, (*focals, 31.125, 18.75 + i / 3, *LENSES[model]))


@pytest.fixture
def scene_of(rng, tmp_path):
    """A function that makes a dataset of a lens: five views, two of them for testing, in two folders."""

    def make(model, lenses=1):
        views = []
        for i in range(5):
            quaternion = rng.normal(size=4)
            rotation = rotation_matrix(*(quaternion / np.linalg.norm(quaternion)))
            pose = np.column_stack([rotation, rng.normal(size=3) * 3])
            lens = make_lens(model, i % lenses)
            name = f"left/ä_{i}.png" if i < 3 else f"right/{i}.png"
            file = tmp_path / "photographs" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(f"photo {i}".encode())
            camera, distortion = (lens.pinhole, lens) if lens.has_distortion else (lens.camera, None)
            views.append(View(name, camera, pose, file, lens=distortion))
        points = PointCloud(rng.normal(size=(7, 3)).astype(np.float32), np.float32(rng.integers(0, 256, (7, 3)) / 255))
        return make_scene(tmp_path / "photographs", views, {0, 3}, points)

    return make


def assert_same_scene(old, new, prefix=""):
    assert [prefix + view.name for view in old.views] == [view.name for view in new.views]
    for a, b in zip(old.views, new.views, strict=True):
        np.testing.assert_allclose(b.world_to_camera, a.world_to_camera, atol=4e-15)
        assert b.camera == a.camera
        assert (b.lens is None) == (a.lens is None)
        assert b.image_path.read_bytes() == a.image_path.read_bytes()
    np.testing.assert_array_equal(new.points.positions, old.points.positions)
    np.testing.assert_array_equal(new.points.colors, old.points.colors)


@pytest.mark.parametrize(("model", "lenses"), list(zip(LENSES, cycle((1, 3)), strict=False)))
def test_colmap_round_trip(model, lenses, scene_of, tmp_path):
    scene = scene_of(model, lenses)
    files = clsplat.write_cameras(scene, tmp_path / "out", "colmap", images="copy")
    assert [file.name for file in files] == ["cameras.bin", "images.bin", "points3D.bin"]
    assert len(read_cameras(tmp_path / "out/sparse/0")) == lenses
    actual = clsplat.read_scene(tmp_path / "out")
    assert_same_scene(scene, actual)
    assert [view.lens for view in actual.views] == [view.lens for view in scene.views]


@pytest.mark.parametrize(("model", "lenses"), list(zip(DISTORTION, cycle((3, 1)), strict=False)))
def test_nerfstudio_round_trip(model, lenses, scene_of, tmp_path, rng):
    scene = scene_of(model, lenses)
    clsplat.write_cameras(scene, tmp_path / "out", "nerfstudio", images="copy")
    actual = clsplat.read_scene(tmp_path / "out")
    assert_same_scene(scene, actual, "images/")
    assert (actual.train, actual.test) == (scene.train, scene.test)
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.ones(20)])
    for a, b in zip(scene.views, actual.views, strict=True):
        if a.lens is not None:
            np.testing.assert_allclose(b.lens.project(rays), a.lens.project(rays), rtol=1e-13)


@pytest.mark.parametrize("model", sorted(LENSES.keys() - DISTORTION.keys()))
def test_lens_unknown_to_nerfstudio_is_refused(model, scene_of, tmp_path):
    with pytest.raises(DataError, match=f"no camera model {model}; use --format colmap, or run `clsplat data"):
        clsplat.write_cameras(scene_of(model), tmp_path / "out", "nerfstudio")
    assert not (tmp_path / "out").exists()
    stage = SimpleNamespace(original=scene_of(model))
    with pytest.raises(DataError, match="no camera model"):
        Cameras(formats=["nerfstudio"]).check_run(stage)
    Cameras(formats=["inria", "colmap"]).check_run(stage)


def test_nerfstudio_has_validation_views_and_one_lens_model(scene_of, tmp_path):
    """It reads `camera_model` from the top alone, and asks for the views of `val_filenames` as it trains."""
    clsplat.write_cameras(scene_of("OPENCV_FISHEYE", 3), tmp_path / "a", "nerfstudio")
    table = json.loads((tmp_path / "a/transforms.json").read_text())
    assert table["camera_model"] == "OPENCV_FISHEYE"
    assert not any("camera_model" in frame for frame in table["frames"])
    assert all({"k1", "fl_x", "cx"} <= frame.keys() for frame in table["frames"]), "all of a lens, or nothing"
    assert table["val_filenames"] == table["test_filenames"] == ["images/left/ä_0.png", "images/right/3.png"]
    scene = scene_of("PINHOLE")
    clsplat.write_cameras(make_scene(scene.path, scene.views, set(), None), tmp_path / "b", "nerfstudio")
    assert not [key for key in json.loads((tmp_path / "b/transforms.json").read_text()) if "filenames" in key]


def test_nerfstudio_refuses_mixed_lens_models(scene_of, tmp_path):
    views = [scene_of("OPENCV").views[0], scene_of("OPENCV_FISHEYE").views[4]]
    with pytest.raises(DataError, match=r"right/4\.png: has the camera model OPENCV_FISHEYE, but others have OPENCV"):
        clsplat.write_cameras(make_scene(tmp_path, views, set(), None), tmp_path / "out", "nerfstudio")


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_cameras_json_has_undistorted_cameras(model, scene_of, tmp_path, caplog):
    scene = scene_of(model, 3)
    with caplog.at_level(logging.WARNING, "clsplat"):
        clsplat.write_cameras(scene, tmp_path, "inria")
    assert "that the principal point is the image center; it is up to" in caplog.text
    result = camera_files.read_inria(tmp_path / "cameras.json")
    for a, b in zip(scene.views, result, strict=True):
        assert (b.name, b.camera) == (a.name, a.camera)
        np.testing.assert_allclose(b.world_to_camera, a.world_to_camera, atol=1e-14)
    first = json.loads((tmp_path / "cameras.json").read_text())[0]
    np.testing.assert_allclose(first["position"], scene.views[0].position)
    np.testing.assert_allclose(np.array(first["rotation"])[:, 2], scene.views[0].world_to_camera[2, :3])


def test_distorted_images_are_refused_with_pinhole_cameras(scene_of, tmp_path):
    with pytest.raises(DataError, match=r"inria has no lens distortion, .*`clsplat data undistort`"):
        clsplat.write_cameras(scene_of("OPENCV"), tmp_path / "a", "inria", images="copy")
    assert not (tmp_path / "a").exists()
    clsplat.write_cameras(scene_of("PINHOLE"), tmp_path / "b", "inria", images="copy")
    assert (tmp_path / "b/images/right/4.png").is_file()


FAULTS = {
    "a table": (lambda d: {"frames": d}, "expected a list of 1 to"),
    "nothing": (lambda d: [], "expected a list of 1 to"),
    "no focal length": (lambda d: [{**d[0], "fx": 0}], r"\[0\]: the camera is 60x40 with focal lengths 0"),
    "no rotation": (lambda d: [{**d[0], "rotation": [[0] * 3] * 3}], "no rotation"),
    "text": (lambda d: [{**d[0], "position": "x"}], "position is 'x'"),
    "ragged": (lambda d: [{**d[0], "rotation": [[1], [2, 3]]}], "rotation is"),
    "large": (lambda d: [{**d[0], "width": 1e9}], "sizes of at most"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_damaged_cameras_json_is_refused(fault, scene_of, tmp_path):
    clsplat.write_cameras(scene_of("PINHOLE"), tmp_path, "inria")
    change, message = FAULTS[fault]
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    with pytest.raises(DataError, match=message):
        camera_files.read_inria(file)


@pytest.mark.parametrize(("form", "lines"), [("colmap", 1), ("inria", 1), ("nerfstudio", 0)])
def test_lost_split_is_logged_in_one_line(form, lines, scene_of, tmp_path, caplog):
    clsplat.write_cameras(scene_of("PINHOLE"), tmp_path, form)
    words = f"{tmp_path}: {form} does not store which 2 of 5 views are test views; nerfstudio does"
    assert [record.levelname for record in caplog.records if record.getMessage() == words] == ["WARNING"] * lines


@pytest.mark.parametrize("form", ["colmap", "nerfstudio", "inria"])
def test_existing_files_are_not_replaced(form, scene_of, tmp_path):
    scene = scene_of("PINHOLE")
    first = clsplat.write_cameras(scene, tmp_path / "a", form)
    again = clsplat.write_cameras(scene, tmp_path / "b", form)
    assert [a.read_bytes() for a in first] == [b.read_bytes() for b in again], "the same bytes"
    with pytest.raises(ConfigError, match="exists; choose another folder"):
        clsplat.write_cameras(scene, tmp_path / "a", form)


def test_unwritable_output_is_refused(scene_of, tmp_path):
    scene = scene_of("PINHOLE")
    with pytest.raises(ConfigError, match="format: expected one of colmap, nerfstudio, inria, got 'meshroom'"):
        clsplat.write_cameras(scene, tmp_path / "out", "meshroom")
    with pytest.raises(ConfigError, match=r"images: expected one of .*, got 'link'"):
        clsplat.write_cameras(scene, tmp_path / "out", images="link")
    view = View("two\nlines", scene.views[0].camera, scene.views[0].world_to_camera)
    alone = make_scene(tmp_path, [view], set(), None)
    with pytest.raises(DataError, match="remove spaces at its ends and line breaks"):
        clsplat.write_cameras(alone, tmp_path / "out")
    nameless = make_scene(tmp_path, [View("a", view.camera, view.world_to_camera)], set(), None)
    with pytest.raises(DataError, match="has no photo to copy"):
        clsplat.write_cameras(nameless, tmp_path / "out", images="copy")
    assert not (tmp_path / "out").exists()


def with_tracks(scene, rng):
    """The scene whose points lie before all cameras; each photograph shows four of them, a little off."""
    views = [
        replace(view, world_to_camera=np.column_stack([np.eye(3), [i / 10, 0, 0]]))
        for i, view in enumerate(scene.views)
    ]
    positions = np.column_stack([rng.uniform(-0.2, 0.2, (7, 2)), rng.uniform(2, 3, 7)]).astype(np.float32)
    seen = {view.name: np.sort(rng.choice(7, 4, replace=False)) for view in views}
    tracks = Tracks(positions, seen, {view.name: rng.normal(0, 1, (4, 2)) for view in views})
    return replace(scene, views=tuple(views), points=replace(scene.points, positions=positions), tracks=tracks)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_colmap_keeps_observations(model, scene_of, tmp_path, rng):
    scene = with_tracks(scene_of(model), rng)
    clsplat.write_cameras(scene, tmp_path / "out", "colmap", images="copy")
    actual = clsplat.read_scene(tmp_path / "out").tracks
    np.testing.assert_array_equal(actual.positions, scene.tracks.positions)
    for view in scene.views:
        np.testing.assert_array_equal(actual.rows[view.name], scene.tracks.rows[view.name])
        np.testing.assert_allclose(actual.residuals[view.name], scene.tracks.residuals[view.name], atol=1e-9)
    data, at, images = (tmp_path / "out/sparse/0/points3D.bin").read_bytes(), 8, read_images(tmp_path / "out/sparse/0")
    while at < len(data):
        (point,), (count,) = struct.unpack_from("<Q", data, at), struct.unpack_from("<Q", data, at + 43)
        for image, place in np.frombuffer(data, "<u4", 2 * count, at + 51).reshape(-1, 2):
            assert images[image - 1].points[place] == point, "both files tell the same"
        at += 51 + 8 * count


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_optimized_cameras_keep_observations(model, scene_of, tmp_path, rng):
    scene = with_tracks(scene_of(model), rng)
    learned = [
        replace(
            view,
            world_to_camera=view.world_to_camera + np.column_stack([np.zeros((3, 3)), [0.1, 0.05, 0]]),
            camera=view.camera.zoomed(1.1),
        )
        for view in scene.views
    ]
    for name, one in (("a", scene), ("b", replace_cameras(scene, learned))):
        clsplat.write_cameras(one, tmp_path / name, "colmap", images="copy")
    pixels = [[image.pixels for image in read_images(tmp_path / name / "sparse/0")] for name in "ab"]
    np.testing.assert_allclose(pixels[1], pixels[0], atol=1e-9)
    (one, *_), actual = scene.views, clsplat.read_scene(tmp_path / "b").tracks
    assert np.abs(actual.residuals[one.name] - scene.tracks.residuals[one.name]).max() > 1, "px"


@pytest.mark.parametrize("form", ["colmap", "nerfstudio"])
def test_exposures_are_written_next_to_copied_images(form, scene_of, tmp_path, rng, caplog):
    scene = with_tracks(scene_of("PINHOLE"), rng)
    noted = {view.name: CameraExposure(0.01 * (i + 1), 2.0, 100.0) for i, view in enumerate(scene.views[1:])}
    write_exposures(tmp_path / "photographs", noted)
    clsplat.write_cameras(scene, tmp_path / "out", form, images="copy")
    actual = clsplat.read_scene(tmp_path / "out")
    told = dict(zip([view.name for view in actual.views], load_exposures(actual.views), strict=True))
    prefix = "images/" if form == "nerfstudio" else ""
    assert told == {prefix + view.name: noted.get(view.name) for view in scene.views}
    assert (actual.tracks is None) == (form == "nerfstudio")
    said = "nerfstudio does not store which points the photos show; colmap does"
    assert (said in caplog.text) == (form == "nerfstudio")
    clsplat.write_cameras(scene, tmp_path / "alone", form)
    assert not (tmp_path / "alone/images").exists()


def test_blender_scene_converts_to_colmap(tiny_scene, tmp_path):
    clsplat.write_cameras(tiny_scene, tmp_path / "out", images="copy")
    old, new = clsplat.read_scene(tiny_scene), clsplat.read_scene(tmp_path / "out")
    actual = {view.name: view for view in new.views}
    assert actual.keys() == {f"{view.name}.png" for view in old.views}
    for view in old.views:
        np.testing.assert_allclose(actual[f"{view.name}.png"].world_to_camera, view.world_to_camera, atol=1e-14)
        np.testing.assert_array_equal(actual[f"{view.name}.png"].photograph(0.0), view.photograph(0.0))


@pytest.mark.slow
def test_command_accepts_a_dataset_or_a_run(few_steps, tiny_scene, tmp_path):
    command("data", "cameras", few_steps, tmp_path / "run", "--format", "nerfstudio", "--images", "copy")
    command("data", "cameras", tiny_scene, tmp_path / "set", "--format", "nerfstudio", "--images", "copy")
    files = [
        sorted(path.relative_to(tmp_path / name) for path in (tmp_path / name).rglob("*")) for name in ("run", "set")
    ]
    assert files[0] == files[1]
    assert (tmp_path / "run/transforms.json").read_bytes() == (tmp_path / "set/transforms.json").read_bytes()
    output = command("data", "cameras", tmp_path / "none", tmp_path / "x", expect=3).stderr
    assert "no such folder" in output


@pytest.mark.parametrize(("format_", "images"), [("nerfstudio", "none"), ("colmap", "none"), ("colmap", "copy")])
def test_folder_without_images_is_reported(format_, images, tiny_scene, tmp_path):
    words = ["data", "cameras", str(tiny_scene), str(tmp_path / "out"), "--format", format_, "--images", images]
    output = CliRunner().invoke(cli.app, words).output
    assert ("with --images copy" in output) == (images == "none")


@pytest.mark.parametrize("name", ["fox_opencv", "fox_nerfstudio", "brighton"])
def test_datasets_survive_both_round_trips(name, tmp_path):
    scene = clsplat.read_scene(data_set(name))
    for form in ("colmap", "nerfstudio"):
        clsplat.write_cameras(scene, tmp_path / form, form, images="copy")
        actual = clsplat.read_scene(tmp_path / form)
        assert len(actual.views) == len(scene.views)
        for a, b in zip(scene.views, actual.views, strict=True):
            turn = a.world_to_camera[:, :3]
            rounding = np.abs(turn @ turn.T - np.eye(3)).max() if form == "colmap" else 0  # a quaternion has none
            np.testing.assert_allclose(b.world_to_camera, a.world_to_camera, atol=2e-13 + 10 * rounding)
            assert b.camera == a.camera
            assert b.image_path.name == a.image_path.name
        shutil.rmtree(tmp_path / form)
