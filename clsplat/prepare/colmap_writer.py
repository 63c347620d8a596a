"""Write a COLMAP model of pinhole cameras: cameras.bin, images.bin, points3D.bin."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.files import atomic
from clsplat.quaternions import unit_quaternions
from clsplat.scene.colmap_binary import POINT2D
from clsplat.scene.scene import Camera, PointCloud, View
from clsplat.scene.tracks import Tracks

PINHOLE = 1  # COLMAP's number of the model
NONE, EXACTLY = np.empty(0, np.int64), np.zeros((1, 2))


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None, tracks: Tracks | None = None) -> None:
    """Write `views`, whose names are those of their images, and points; cameras that are equal are one.

    tracks: which of the points, in their order, each view shows; their places in an image are where the camera projects
    them to, and as far from there as they were in the photograph.  Raises OutputError.
    """
    cameras: dict[Camera, int] = {}
    for view in views:
        cameras.setdefault(view.camera, len(cameras) + 1)
    seen = {view.name: tracks.seen.get(view.name, NONE) if tracks and points else NONE for view in views}
    rows = [_camera(number, camera) for camera, number in cameras.items()]
    _write(folder / "cameras.bin", rows)
    missed = {
        view.name: tracks.misses.get(view.name, EXACTLY) / view.downscale if tracks else EXACTLY for view in views
    }
    images = [
        _image(i, view, cameras[view.camera], _shown(points, seen[view.name], view, missed[view.name]))
        for i, view in enumerate(views, 1)
    ]
    _write(folder / "images.bin", images)
    _write(folder / "points3D.bin", [] if points is None else _points(points, list(seen.values())))


def _write(path: Path, rows: Sequence[bytes]) -> None:
    with atomic(path) as file:
        file.write(struct.pack("<Q", len(rows)) + b"".join(rows))


def _camera(number: int, camera: Camera) -> bytes:
    params = camera.fx, camera.fy, camera.cx, camera.cy
    return struct.pack("<IiQQ4d", number, PINHOLE, camera.width, camera.height, *params)


def _image(number: int, view: View, camera: int, shown: NDArray[Any]) -> bytes:
    quaternion = unit_quaternions(view.world_to_camera[:, :3])
    pose = struct.pack("<I7dI", number, *quaternion, *view.world_to_camera[:, 3], camera)
    return pose + view.name.encode() + b"\0" + struct.pack("<Q", len(shown)) + shown.tobytes()


def _shown(
    points: PointCloud | None, rows: NDArray[np.int64], view: View, missed: NDArray[np.floating]
) -> NDArray[Any]:
    """The 2D points of a view; missed: [K or 1, 2] px from where it projects them to."""
    table = np.zeros(len(rows), POINT2D)
    if points is not None:
        table["point"] = rows + 1
        places = points.positions[rows] @ view.world_to_camera[:, :3].T + view.world_to_camera[:, 3]
        depth = np.where(places[:, 2] > 0, places[:, 2], 1)
        focal, centre = (view.camera.fx, view.camera.fy), (view.camera.cx, view.camera.cy)
        table["xy"] = places[:, :2] / depth[:, None] * focal + centre + np.nan_to_num(missed)
    return table


def _points(points: PointCloud, seen: Sequence[NDArray[np.int64]]) -> list[bytes]:
    """seen: the rows of points that each image shows, by its number less 1."""
    tracks: list[bytes] = [b""] * len(points)
    for number, rows in enumerate(seen, 1):
        for place, row in enumerate(rows):
            tracks[row] += struct.pack("<II", number, place)
    rgb = np.rint(points.colours * 255).astype(np.uint8)
    table = zip(points.positions.astype(float), rgb, tracks, strict=True)
    return [
        struct.pack("<Q3d3BdQ", i, *position, *colour, 0.0, len(track) // 8) + track
        for i, (position, colour, track) in enumerate(table, 1)
    ]
