"""Scenes with a transforms.json."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.points import read_points_ply, write_points_ply
from clsplat.scene.scene import PointCloud
from clsplat.scene.transforms_json import opengl_matrix
from clsplat.scene.view import View


def several_cameras(folder: Path, counts: dict[str, int], *posed: str) -> Path:
    """Videos as folders of frames, and a transforms.json with a pose for each camera."""
    rng = np.random.default_rng(3)
    for name, count in counts.items():
        (folder / "videos" / name).mkdir(parents=True)
        for i in range(count):
            image = rng.integers(0, 255, (48, 64, 3), np.uint8)
            cv2.imwrite(str(folder / "videos" / name / f"{i:04}.png"), image)
    names = [f"images/{name}.png" for name in posed or counts]
    (folder / "transforms.json").write_text(json.dumps(LENS | {"frames": frames(*names)}))
    return folder


# An OpenGL camera at (1, 2, 5) that looks down the world's -z, with y up: the identity but for its place.
POSE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 5], [0, 0, 0, 1]]


SIDE = [[0, 0, 1, 9], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]


LENS = {"fl_x": 50, "fl_y": 51.5, "cx": 30.5, "cy": 25, "w": 64, "h": 48}


def frames(*names: str, **values) -> list[dict]:
    poses = [POSE, SIDE]
    return [{"file_path": name, "transform_matrix": poses[i % 2]} | values for i, name in enumerate(names)]


def write(path: Path, name: str = "transforms.json", size: tuple[int, int] = (64, 48), **table) -> Path:
    """Write one JSON file and a gray image for each of its frames; return the folder."""
    path.mkdir(parents=True, exist_ok=True)
    (path / name).write_text(json.dumps(table))
    for frame in table["frames"]:
        file = (path / frame["file_path"]).with_suffix(Path(frame["file_path"]).suffix or ".png")
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), _nearly_plain(size, 128))
    return path


def _nearly_plain(size: tuple[int, int], level: int) -> np.ndarray:
    """An image of one color but for one pixel: photographs of one color are refused before training."""
    pixels = np.full((size[1], size[0], 3), level, np.uint8)
    pixels[-1, -1] = 200
    return pixels


# A dataset of nerfstudio that is moved as a whole, with four cameras around a few points.

CENTERS = np.array([[1.25, 0, 2], [-2, 0.5, 1], [0.25, -3, 2], [2, 2, -1.5]])
SHIFTED_POINTS = np.array([[0.125, 0.25, -0.5], [0.5, -0.5, 0.25], [0, 0, 0]])


def write_shifted(folder, shift=0.0):
    """A nerfstudio dataset whose coordinates are all moved by `shift`."""
    frames = []
    for i, center in enumerate(CENTERS):
        matrix = opengl_matrix(View.looking_at(center, (0, 0, 0), (0, 0, 1), None).world_to_camera)
        matrix[:3, 3] = center + shift
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix.tolist()})
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_image(folder / "images" / f"{i}.png", _nearly_plain((64, 48), 50 * i))
    (folder / "transforms.json").write_text(json.dumps(LENS | {"frames": frames, "ply_file_path": "p.ply"}))
    write_points_ply(folder / "p.ply", PointCloud(SHIFTED_POINTS + shift, np.full((3, 3), 0.5)))
    return read_scene(folder, holdout=0)


def scaled(scene: Path, folder: Path, factor: float) -> Path:
    """Copy a synthetic scene in another unit of length."""
    shutil.copytree(scene, folder)
    for file in folder.glob("transforms*.json"):
        table = json.loads(file.read_text())
        for frame in table["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] *= factor
            frame["transform_matrix"] = pose.tolist()
        file.write_text(json.dumps(table))
    for file in folder.glob("*.ply"):
        points = read_points_ply(file)
        write_points_ply(file, replace(points, positions=points.positions * factor))
    return folder
