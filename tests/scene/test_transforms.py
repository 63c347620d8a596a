"""The readers of Blender and nerfstudio datasets."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from clsplat.scene.camera import Camera
from clsplat.scene.detect import read_scene
from clsplat.scene.reader import Parts
from clsplat.scene.transforms_json import NerfstudioReader
from clsplat.scene.view import load_image
from tests.support.data_sets import data_set
from tests.support.refusals import refusal
from tests.support.transforms_scene import LENS, POSE, frames, write

# ---- real data


def test_cameras_of_lego_look_at_the_origin() -> None:
    path = data_set("lego_200")
    scene = read_scene(path)
    assert (len(scene.train), len(scene.test)) == (100, 25)
    assert scene.split("train")[0].name == "train/r_0"
    assert {view.name.split("/")[0] for view in scene.split("test")} == {"test"}
    table = json.loads((path / "transforms_train.json").read_text())
    for view, frame in zip(scene.split("train"), table["frames"], strict=True):
        np.testing.assert_allclose(view.position, np.array(frame["transform_matrix"])[:3, 3], atol=1e-5)
        # Every camera looks at the origin, so that lies straight ahead, at the distance of the camera.
        np.testing.assert_allclose(view.world_to_camera[:, 3], (0, 0, np.linalg.norm(view.position)), atol=1e-5)
        assert view.image_path.is_file()
    camera = scene.views[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (200, 200, 100, 100)
    assert camera.fx == camera.fy == pytest.approx(100 / math.tan(table["camera_angle_x"] / 2))
    assert scene.extent == pytest.approx(5.2, abs=0.1)
    assert scene.background == "white"
    assert scene.points is None


def test_lego_is_upright_and_transparent() -> None:
    view = read_scene(data_set("lego_200")).views[0]
    assert view.world_to_camera[1, 2] < -0.9  # the world's z is up, a pixel's y down
    assert load_image(view, (1.0, 1.0, 1.0))[0, 0].tolist() == [255, 255, 255]
    assert load_image(view)[0, 0].tolist() == [0, 0, 0]


def test_distorted_fox_has_the_lens_of_its_colmap_model() -> None:
    views = {v.name.rpartition("/")[2]: v for v in read_scene(data_set("fox_nerfstudio")).views}
    for other in read_scene(data_set("fox_opencv")).views:
        view = views[other.name]
        assert view.lens
        np.testing.assert_allclose(view.lens.params, other.lens.params, rtol=1e-3, atol=1e-3)


def test_fox_has_the_poses_of_its_colmap_model(tmp_path: Path) -> None:
    """The worlds differ by a rotation and a shift, so compare each camera with the first."""
    path = data_set("fox_nerfstudio")
    table = json.loads((path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps(table | dict.fromkeys(("k1", "k2", "p1", "p2"), 0)))
    (tmp_path / "images").symlink_to(path / "images")
    ours, theirs = read_scene(tmp_path), read_scene(data_set("fox"))
    assert ours.test == theirs.test
    for one, other in zip(ours.views, theirs.views, strict=True):
        assert one.name == f"images/{other.name}"
        relative = [
            view.world_to_camera[:, :3] @ scene.views[0].world_to_camera[:, :3].T
            for view, scene in ((one, ours), (other, theirs))
        ]
        np.testing.assert_allclose(*relative, atol=1e-5)
        ahead = [
            view.world_to_camera @ np.append(scene.views[0].position, 1)
            for view, scene in ((one, ours), (other, theirs))
        ]
        np.testing.assert_allclose(*ahead, atol=1e-4)
    assert ours.extent == pytest.approx(theirs.extent, rel=1e-5)


# ---- poses and cameras


def test_opengl_axes_become_opencv_axes(tmp_path: Path) -> None:
    scene = read_scene(write(tmp_path, **LENS, frames=frames("a.png", "b.png")))
    view, side = scene.views
    np.testing.assert_allclose(view.position, (1, 2, 5))
    # (2, 4, 1) is 1 to the right of the camera, 2 above it (so y is -2), and 4 in front of it.
    np.testing.assert_allclose(view.world_to_camera @ (2, 4, 1, 1), (1, -2, 4))
    np.testing.assert_allclose(side.position, (9, 0, 0))
    np.testing.assert_allclose(side.world_to_camera @ (0, 0, -3, 1), (3, 0, 9))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (LENS, Camera(64, 48, 50, 51.5, 30.5, 25)),
        ({"fl_x": 50, "w": 64, "h": 48}, Camera(64, 48, 50, 50, 32, 24)),
        ({"fl_x": "50", "w": "64", "h": "48.0"}, Camera(64, 48, 50, 50, 32, 24)),
        ({"x_fov": 90}, Camera(64, 48, 32, 32, 32, 24)),
        ({"fl_x": 50, "camera_angle_x": 1, "cx": 0}, Camera(64, 48, 50, 50, 0, 24)),
        ({"camera_angle_x": math.pi / 2}, Camera(64, 48, 32, 32, 32, 24)),
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, Camera(64, 48, 32, 24, 32, 24)),
        (
            LENS | {"camera_model": "OPENCV", "k1": 0.0, "p2": 0, "is_fisheye": False},
            Camera(64, 48, 50, 51.5, 30.5, 25),
        ),
    ],
)
def test_intrinsics_of_a_frame_override_shared_ones(tmp_path: Path, values: dict, expected: Camera) -> None:
    """Per-frame values take precedence over shared ones."""
    per_frame = len(values) % 2 == 0
    wrong = dict.fromkeys(values, "overridden")
    table = (
        {"frames": frames("a.png", "b.png", **values)} | wrong
        if per_frame
        else values | {"frames": frames("a.png", "b.png")}
    )
    camera = read_scene(write(tmp_path, **table)).views[1].camera
    for ours, theirs in zip(vars(camera).values(), vars(expected).values(), strict=True):
        assert ours == pytest.approx(theirs)


def test_scale_of_a_rotation_is_ignored(tmp_path: Path) -> None:
    scaled = [[*(2.5 * value for value in row[:3]), str(row[3])] for row in POSE[:3]]
    view, _ = read_scene(write(tmp_path, **LENS, frames=frames("a.png", "b.png", transform_matrix=scaled))).views
    np.testing.assert_allclose(view.world_to_camera @ (2, 4, 1, 1), (1, -2, 4))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k5": 0.1}, "k5"),
        ({"k4": -1e-9}, "k4"),
        ({"camera_model": "OPENCV_FISHEYE", "p2": 0.1}, "p2"),
        ({"is_fisheye": True, "k6": 1.0}, "camera_model"),
        ({"fl_x": 0}, "focal lengths 0, 51.5"),
        ({"fl_x": "fifty"}, "'fifty'"),
        ({"fl_x": math.nan}, "nan"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"fl_x": None, "camera_angle_x": 4}, "camera_angle_x is 4"),
        ({"w": -64}, "-64"),
        ({"cx": 10**400}, "cx"),
        ({"cx": True}, "True"),
        ({"transform_matrix": None}, "transform_matrix"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, "transform_matrix"),
        ({"transform_matrix": [[1, 0, 0, "x"], *POSE[1:]]}, "transform_matrix"),
        ({"transform_matrix": [[1, 0, 0, math.nan], *POSE[1:]]}, "transform_matrix"),
        ({"transform_matrix": [[10**400, 0, 0, 1], *POSE[1:]]}, "transform_matrix"),
        ({"transform_matrix": [[-1, 0, 0, 1], *POSE[1:]]}, "transform_matrix"),  # a mirror
        ({"transform_matrix": [[2, 0, 0, 1], [0, 2, 0, 1], [0, 0, 1, 1], POSE[3]]}, "transform_matrix"),  # two scales
        ({"transform_matrix": [[0] * 4] * 4}, "transform_matrix"),
        ({"file_path": None}, "file_path"),
        ({"file_path": 3}, "file_path"),
        ({"file_path": "../a.png"}, "'../a.png' is not a path below"),
        ({"file_path": "/a.png"}, "not a path below"),
        ({"file_path": "x\\..\\..\\a.png"}, "not a path below"),
        ({"camera_model": ["X"]}, "camera_model ['X']; expected one of"),
        ({"camera_model": "X" * 6000}, "camera_model 'XXX"),
        ({"fl_x": [[5] * 1000] * 10}, "fl_x is [[5, 5, "),
        ({"file_path": {"x" * 6000: 1}}, "file_path is {'xxx"),
        ({"fl_x": 5e-324, "k1": 0.1}, "the camera is 64x48 with focal lengths 4.9"),
        ({"w": 2**15 + 1}, "the camera is 32769x48"),
        ({"w": 10**14, "h": 10**14, "k1": 0.1}, "the camera is 100000000000000x100000000000000"),
        ({"mask_path": "../a.png"}, "not a path below"),
        ({"mask_path": "masks/a.png"}, "1 of 1 image files are missing"),
    ],
)
def test_damaged_frame_is_named(tmp_path: Path, change: dict, message: str) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "b.png"))
    table = LENS | {"frames": frames("a.png", "b.png")}
    table["frames"][1] |= change
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    text = refusal(read_scene, tmp_path)
    assert message in text
    assert "frames[1]" in text or "missing" in text
    assert len(text) < len(str(tmp_path)) * 2 + 400


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"frames": 3}', '{"frames": [1]}', "\xff"])
def test_file_without_transforms_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    assert "transforms.json: " in refusal(read_scene, tmp_path)


def test_null_camera_model_is_refused(tmp_path: Path) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "b.png", camera_model=None))
    assert len(read_scene(tmp_path).views) == 2


def test_too_many_frames_are_refused_before_they_are_read(tmp_path: Path, monkeypatch) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "b.png", "c.png"))
    monkeypatch.setattr("clsplat.scene.transforms_json.MAX_FRAMES", 2)
    assert "has 3 frames; expected at most 2: split the scene" in refusal(read_scene, tmp_path)


def test_shared_values_are_not_copied_per_frame(tmp_path: Path) -> None:
    shared = {f"key {i}": i for i in range(2000)}
    table = LENS | shared | {"frames": frames(*(f"{i}.png" for i in range(2000)))}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    assert "2000 of 2000 image files are missing" in refusal(read_scene, tmp_path)


def test_thousand_damaged_frames_are_a_thousand_faults(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [{}] * 1000}))
    parts = Parts(tmp_path)
    NerfstudioReader().list_parts(parts)
    assert len(parts.faults) == len(set(parts.faults)) == 1000


def test_file_without_frames_is_refused(tmp_path: Path) -> None:
    assert "no images" in refusal(read_scene, write(tmp_path, **LENS, frames=[]))


def test_missing_images_are_counted(tmp_path: Path) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "b.png"))
    (tmp_path / "b.png").unlink()
    assert "1 of 2 image files are missing" in refusal(read_scene, tmp_path)


def test_backslashes_and_masks_in_paths_are_accepted(tmp_path: Path) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "images/b.png"))
    table = LENS | {"frames": frames(".\\images\\b.png", mask_path="./a.png")}
    (tmp_path / "transforms.json").write_text(json.dumps(table | {"test_filenames": []}))
    (view,) = read_scene(tmp_path).views
    assert view.name == "images/b.png"
    assert view.mask_path == tmp_path / "a.png"


# ---- splits


def test_blender_split_follows_its_files(tmp_path: Path) -> None:
    table = {"camera_angle_x": 0.7}
    write(tmp_path, "transforms_train.json", **table, frames=frames("./train/r_0", "./train/r_1", "./train/r_10"))
    assert read_scene(tmp_path, holdout=2).test == ()
    write(tmp_path, "transforms_test.json", **table, frames=frames("./test/r_0"))
    scene = read_scene(tmp_path, holdout=2)
    assert [view.name for view in scene.views] == ["train/r_0", "train/r_1", "train/r_10", "test/r_0"]
    assert scene.test == (3,)
    assert scene.views[0].image_path == tmp_path / "train" / "r_0.png"
    assert scene.views[0].camera.width == 64


def test_blender_files_may_have_intrinsics(tmp_path: Path) -> None:
    write(tmp_path, "transforms_train.json", **LENS, frames=frames("a.jpg", "b.jpg"))
    scene = read_scene(tmp_path)
    assert scene.views[0].camera == Camera(64, 48, 50, 51.5, 30.5, 25)
    assert scene.views[0].image_path == tmp_path / "a.jpg"


def test_nerfstudio_holds_out_every_nth_by_name(tmp_path: Path) -> None:
    write(tmp_path, **LENS, frames=frames("c.png", "a.png", "b.png"))
    scene = read_scene(tmp_path, holdout=2)
    assert [view.name for view in scene.views] == ["a.png", "b.png", "c.png"]
    assert scene.test == (0, 2)


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train_filenames": ["c.png", "./a.png"], "test_filenames": ["b.png"]}, ["a.png", "c.png"], ["b.png"]),
        ({"test_filenames": ["b.png"]}, ["a.png", "c.png", "d.png"], ["b.png"]),
        ({"train_filenames": ["d.png"]}, ["d.png"], []),
        ({"train_filenames": ["a.png"], "test_filenames": [], "val_filenames": ["b.png"]}, ["a.png"], []),
    ],
)
def test_nerfstudio_lists_define_the_split(tmp_path: Path, lists: dict, train: list[str], test: list[str]) -> None:
    scene = read_scene(write(tmp_path, **LENS, **lists, frames=frames("a.png", "b.png", "c.png", "d.png")))
    assert [view.name for view in scene.split("train")] == train
    assert [view.name for view in scene.split("test")] == test


@pytest.mark.parametrize("entries", ["a.png", [1], ["z.png"]])
def test_invalid_nerfstudio_list_is_refused(tmp_path: Path, entries) -> None:
    assert "test_filenames" in refusal(
        read_scene, write(tmp_path, **LENS, test_filenames=entries, frames=frames("a.png", "b.png"))
    )
