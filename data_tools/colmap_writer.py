"""Write a COLMAP model of pinhole cameras: cameras.bin, images.bin, points3D.bin."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clsplat.files import atomic
from clsplat.scene.quaternion import unit_quaternions
from clsplat.scene.scene import Camera, PointCloud, View

PINHOLE = 1  # COLMAP's number of the model


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None) -> None:
    """Write `views`, whose names are those of their images, and points; cameras that are equal are one.

    The tracks of points are not written: no reader of scenes uses them.  Raises OutputError.
    """
    cameras: dict[Camera, int] = {}
    for view in views:
        cameras.setdefault(view.camera, len(cameras) + 1)
    rows = [_camera(number, camera) for camera, number in cameras.items()]
    _write(folder / "cameras.bin", rows)
    _write(folder / "images.bin", [_image(i, view, cameras[view.camera]) for i, view in enumerate(views, 1)])
    _write(folder / "points3D.bin", [] if points is None else _points(points))


def _write(path: Path, rows: Sequence[bytes]) -> None:
    with atomic(path) as file:
        file.write(struct.pack("<Q", len(rows)) + b"".join(rows))


def _camera(number: int, camera: Camera) -> bytes:
    params = camera.fx, camera.fy, camera.cx, camera.cy
    return struct.pack("<IiQQ4d", number, PINHOLE, camera.width, camera.height, *params)


def _image(number: int, view: View, camera: int) -> bytes:
    quaternion = unit_quaternions(view.world_to_camera[:, :3])
    pose = struct.pack("<I7dI", number, *quaternion, *view.world_to_camera[:, 3], camera)
    return pose + view.name.encode() + b"\0" + struct.pack("<Q", 0)


def _points(points: PointCloud) -> list[bytes]:
    rgb = np.rint(points.colours * 255).astype(np.uint8)
    table = zip(points.positions.astype(float), rgb, strict=True)
    return [struct.pack("<Q3d3BdQ", i, *position, *colour, 0.0, 0) for i, (position, colour) in enumerate(table, 1)]
