"""Damaged datasets: COLMAP (binary and text) and transforms.json, read and inspected."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.prepare.inspect.findings import Inspection
from clsplat.scene.detect import read_scene
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome
from tests.support.colmap_writer import CameraEntry, ColmapModel, tiny_model, write_scene

POSE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 5], [0, 0, 0, 1]]
KEYS = ["w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "camera_angle_x", "camera_model", "is_fisheye"]
WORDS = [
    f'"{key}": '
    for key in [*KEYS, "file_path", "mask_path", "ply_file_path", "frames", "test_filenames", "time", "static_path"]
]
WORDS += [
    '"OPENCV_FISHEYE"',
    '"EQUIRECTANGULAR"',
    '"a.png"',
    "[[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 5]]",
    '{"file_path": "a.png"}, ',
    "[],",
]
MODELS = [
    "SIMPLE_RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "EQUIRECTANGULAR",
    "EUCM",
    "PINHOLE",
    "7",
    "a.jpg",
    "# ",
]


def read_and_inspect(path: Path) -> None:
    """A scene that is read has finite cameras; whatever it is, it can be inspected, and the result written."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = outcome(read_scene, path)
        inspection = outcome(Inspection.from_folder, path)
    assert inspection is not None
    json.dumps(inspection.data())
    assert len(inspection.verdict) < 2000
    if scene is not None:
        assert all(np.isfinite(view.world_to_camera).all() for view in scene.views)
        assert all(view.image_path.is_relative_to(path) for view in scene.views)
        assert np.isfinite(scene.extent)


def photo(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, np.full((48, 64, 3), 90, np.uint8))[1].tobytes())


def colmap(folder: Path, kind: str) -> tuple[Path, dict[str, list[bytes]]]:
    """A scene, and its files by name as seeds: with and without distortion."""
    cameras = [
        CameraEntry(1, "SIMPLE_RADIAL", 64, 48, (50.0, 30.5, 25.25, 0.01)),
        CameraEntry(1, "OPENCV_FISHEYE", 64, 48, (50.0, 51.0, 30.5, 25.25, 0.01, 0, 0, 0)),
        CameraEntry(1, "FOV", 64, 48, (50.0, 51.0, 30.5, 25.25, 0.1)),
        CameraEntry(1, "FISHEYE", 64, 48, (20.0, 21.0, 30.5, 25.25)),
        CameraEntry(1, "EUCM", 64, 48, (20.0, 21.0, 30.5, 25.25, 0.6, 1.1)),
        CameraEntry(1, "EQUIRECTANGULAR", 64, 48, (64, 48)),
    ]
    models: list[ColmapModel] = [*(replace(tiny_model(), cameras=[camera]) for camera in cameras), tiny_model()]
    seeds: dict[str, list[bytes]] = {"cameras": [], "images": [], "points3D": []}
    for model in models:
        path = write_scene(folder / kind, model, kind)
        for stem, files in seeds.items():
            files.append((path / "sparse" / "0" / f"{stem}.{kind}").read_bytes())
    for image in models[-1].images:
        photo(path / "images" / image.name)
    return path, seeds


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_damaged_colmap_model_is_read_or_refused(stem, kind, folder):
    path, seeds = colmap(folder, kind)

    @fuzzed(data=damaged(seeds[stem], MODELS))
    def reads(data):
        (path / "sparse" / "0" / f"{stem}.{kind}").write_bytes(data)
        read_and_inspect(path)

    reads()
    for name, files in seeds.items():
        (path / "sparse" / "0" / f"{name}.{kind}").write_bytes(files[-1])


def tables() -> list[bytes]:
    """Nerfstudio's and Blender's notations, with lenses, masks, points and splits."""
    frames = [{"file_path": f"{name}.png", "transform_matrix": POSE} for name in "ab"]
    lens = {"fl_x": 50, "fl_y": 51.5, "cx": 30.5, "cy": 25, "w": 64, "h": 48}
    own = [{**frame, **lens, "k1": 0.01, "camera_model": "OPENCV"} for frame in frames]
    masked = [{**frame, "mask_path": "a.png"} for frame in frames]
    actual = [
        {**lens, "frames": frames, "test_filenames": ["a.png"], "train_filenames": ["b.png"]},
        {"frames": own, "ply_file_path": "points.ply"},
        {"camera_angle_x": 0.7, "frames": [{**frame, "file_path": f"./{frame['file_path'][0]}"} for frame in frames]},
        {**lens, "camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.001, "frames": masked},
        {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 48, "frames": frames},
        {**lens, "frames": [{**frame, "time": i, "static_path": "a.png"} for i, frame in enumerate(frames)]},
    ]
    return [json.dumps(table, indent=i % 2 or None).encode() for i, table in enumerate(actual)]


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_damaged_transforms_file_is_read_or_refused(name, folder):
    path = folder / name.partition(".")[0]
    for photograph in "ab":
        photo(path / f"{photograph}.png")

    @fuzzed(data=damaged(tables(), WORDS))
    def reads(data):
        (path / name).write_bytes(data)
        read_and_inspect(path)

    reads()


def test_damaged_table_of_sizes_is_read_or_refused(folder):
    path = folder / "multiscale"
    for photograph in "ab":
        photo(path / f"{photograph}.png")
    column = {"file_path": ["a.png"], "cam2world": [POSE], "width": [64], "height": [48], "focal": [50.0], "label": [0]}
    table = {"train": column, "test": column | {"file_path": ["b.png"], "label": [1]}}

    @fuzzed(data=damaged([json.dumps(table).encode()], WORDS))
    def reads(data):
        (path / "metadata.json").write_bytes(data)
        read_and_inspect(path)

    reads()


def test_damaged_table_of_times_is_read_or_refused(folder):
    path, _ = colmap(folder, "txt")
    moments = {image.name: float(i) for i, image in enumerate(tiny_model().images)}

    @fuzzed(data=damaged([json.dumps(moments).encode()], ["1e400", "null", "[1]", '"a.jpg": ']))
    def reads(data):
        (path / "images" / "times.json").write_bytes(data)
        read_and_inspect(path)

    reads()
    (path / "images" / "times.json").unlink()


def test_damaged_video_cameras_are_read_or_refused(folder):
    path = folder / "videos_of_two"
    for name in ("a/0.png", "a/1.png", "b/0.png", "b/1.png"):
        photo(path / "videos" / name)

    @fuzzed(data=damaged(tables(), WORDS))
    def reads(data):
        (path / "transforms.json").write_bytes(data)
        read_and_inspect(path)

    reads()


def test_damaged_poses_of_llff_are_read_or_refused(folder):
    path, seeds = folder / "llff", []
    for name in "ab":
        photo(path / "images" / f"{name}.png")
    row = np.concatenate([np.hstack([np.eye(3, 4), [[48], [64], [50]]]).ravel(), [1, 9]])
    for kind in ("<f8", "<f4", ">f8"):
        np.save(path / "poses_bounds.npy", np.array([row, row], kind))
        seeds.append((path / "poses_bounds.npy").read_bytes())

    @fuzzed(
        data=damaged(seeds, ["(2, 17)", "(99999999999, 17)", "True", "'|O'", "'descr'", "'<f2'", "(2, 17, )", "PK"])
    )
    def reads(data):
        (path / "poses_bounds.npy").write_bytes(data)
        read_and_inspect(path)

    reads()
