"""Scenes with a transforms.json."""

import json
from pathlib import Path

import cv2
import numpy as np


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
        cv2.imwrite(str(file), np.full((size[1], size[0], 3), 128, np.uint8))
    return path
