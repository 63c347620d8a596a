"""cameras.json, as the reference implementation of 3DGS writes it beside a model (Kerbl et al. 2023).

A list of tables: id, img_name, width, height, position and rotation (camera to world, OpenCV axes), fx, fy.  Cameras
are those of undistorted photographs.  The format has no principal point; ours is in the keys cx and cy, which other
programs pass over.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.cameras.lost import centre_lost
from clsplat.cameras.posed import Posed
from clsplat.errors import DataError, PoseError, quoted
from clsplat.files import write_text
from clsplat.reading import read_json
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Camera
from clsplat.scene.scene import PointCloud
from clsplat.scene.tracks import Tracks
from clsplat.scene.transforms import Frame
from clsplat.scene.view import View

FILE = "cameras.json"
MAX_BYTES = 1 << 27
MAX_VIEWS = 100_000


def write(out: Path, views: list[Posed], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write out/cameras.json; return it.  Points and tracks have no place in it.  Raises OutputError."""
    write_text(out / FILE, json.dumps([_camera(one, i) for i, one in enumerate(views)], indent=1) + "\n")
    centre_lost(out / FILE, [one.view.camera for one in views], "other programs")
    return [out / FILE]


def _camera(one: Posed, number: int) -> dict[str, Any]:
    camera, pose = one.view.camera, one.view.world_to_camera
    return {
        "id": number,
        "img_name": one.name,
        "width": camera.width,
        "height": camera.height,
        "position": one.view.position.tolist(),
        "rotation": pose[:, :3].T.tolist(),
        "fy": camera.fy,
        "fx": camera.fx,
        "cx": camera.cx,
        "cy": camera.cy,
    }


def read(path: Path) -> list[View]:
    """Return the views of a cameras.json, without photographs.

    Raises DataError for another file and for damaged numbers.
    """
    table = read_json(path, "a cameras.json of 3DGS", limit=MAX_BYTES)
    if not isinstance(table, list) or not 1 <= len(table) <= MAX_VIEWS or not all(isinstance(v, dict) for v in table):
        raise DataError(f"{path}: expected a list of 1 to {MAX_VIEWS} cameras, as 3DGS writes it")
    return [_view(Frame(path.parent, f"{path}: [{i}]", one), i) for i, one in enumerate(table)]


def _view(one: Frame, number: int) -> View:
    width, height, fx, fy = (one.number(key) or 0.0 for key in ("width", "height", "fx", "fy"))
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or min(fx, fy) < MIN_FOCAL:
        raise DataError(
            f"{one.where}: the camera is {width:g}x{height:g} with focal lengths {fx:g}, {fy:g}; expected positive "
            f"numbers, sizes of at most {MAX_SIDE}: export the file again"
        )
    cx, cy = one.number("cx"), one.number("cy")
    camera = Camera(int(width), int(height), fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    name = one.value("img_name")
    rotation, position = _array(one, "rotation", (3, 3)), _array(one, "position", (3,))
    try:
        pose = np.column_stack([rotation.T, -rotation.T @ position])
        return View(name if isinstance(name, str) else f"{number:05d}", camera, pose)
    except PoseError as error:
        raise DataError(f"{one.where}: {error}; remove that camera or export the file again") from error


def _array(one: Frame, key: str, shape: tuple[int, ...]) -> "np.ndarray[Any, np.dtype[np.float64]]":
    try:
        array = np.array(one.value(key), np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise DataError(f"{one.where}: {key} is {quoted(one.value(key))}; expected finite numbers, {shape}")
    return array
