"""Write COLMAP's binary model: cameras, images, and points with their tracks."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.files import open_atomic
from clsplat.core.quaternions import unit_quaternions
from clsplat.scene.camera import Lens
from clsplat.scene.colmap import MODELS, POINT2D
from clsplat.scene.reprojection import project_points
from clsplat.scene.scene import PointCloud, Scene, Tracks
from clsplat.scene.view import View, photo_lens

MODEL = Path("sparse/0")  # the folder of the model, next to the folder of the images
FILES = ("cameras.bin", "images.bin", "points3D.bin")
NO_RESIDUAL = np.zeros((1, 2))


def write_colmap(out: Path, scene: Scene) -> list[Path]:
    """Write the model to out/sparse/0 and return the paths of its files.  Raises OutputError."""
    write_model(out / MODEL, scene.views, scene.points, scene.tracks)
    return [out / MODEL / name for name in FILES]


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None, tracks: Tracks | None = None) -> None:
    """Write views, named like their images, and points to a folder; views with equal lenses share a camera.

    tracks: which points each view shows; the 2D points are their projections plus the residuals.  Raises OutputError.
    """
    lenses = [photo_lens(view) for view in views]
    camera_ids = {lens: camera_id for camera_id, lens in enumerate(dict.fromkeys(lenses), 1)}
    points2d = [_project_points2d(points, view, tracks) for view in views]
    images = zip(views, lenses, points2d, strict=True)
    contents = (
        [_pack_camera(camera_id, lens) for lens, camera_id in camera_ids.items()],
        [_pack_image(i, view, camera_ids[lens], table) for i, (view, lens, table) in enumerate(images, 1)],
        [] if points is None else _pack_points(points, points2d),
    )
    for name, records in zip(FILES, contents, strict=True):
        with open_atomic(folder / name) as file:
            file.write(struct.pack("<Q", len(records)) + b"".join(records))


def _pack_camera(camera_id: int, lens: Lens) -> bytes:
    values = camera_id, MODELS.index(lens.model), lens.width, lens.height, *lens.params
    return struct.pack(f"<IiQQ{len(lens.params)}d", *values)


def _pack_image(image_id: int, view: View, camera_id: int, points2d: NDArray[Any]) -> bytes:
    quaternion = unit_quaternions(view.world_to_camera[:, :3])
    pose = struct.pack("<I7dI", image_id, *quaternion, *view.world_to_camera[:, 3], camera_id)
    return pose + view.name.encode() + b"\0" + struct.pack("<Q", len(points2d)) + points2d.tobytes()


def _project_points2d(points: PointCloud | None, view: View, tracks: Tracks | None) -> NDArray[Any]:
    """Return the 2D points of a view, one for each of its tracked points in front of the camera."""
    if points is None or tracks is None or view.name not in tracks.rows:
        return np.zeros(0, POINT2D)
    rows, residuals = tracks.rows[view.name], tracks.residuals.get(view.name, NO_RESIDUAL) / view.downscale
    pixels = project_points(view, points.positions[rows]) + np.nan_to_num(residuals)
    is_finite = np.isfinite(pixels).all(axis=1)
    table = np.zeros(np.count_nonzero(is_finite), POINT2D)
    table["point"], table["xy"] = rows[is_finite] + 1, pixels[is_finite]
    return table


def _pack_points(points: PointCloud, points2d: Sequence[NDArray[Any]]) -> list[bytes]:
    """Return the binary record of each point, with its track.  points2d: the 2D points of each image."""
    tracks: list[bytes] = [b""] * len(points)
    for image_id, table in enumerate(points2d, 1):
        for index, point_id in enumerate(table["point"].tolist()):
            tracks[point_id - 1] += struct.pack("<II", image_id, index)
    rgb = np.rint(points.colors * 255).astype(np.uint8)
    rows = zip(points.positions.astype(float), rgb, tracks, strict=True)
    return [
        struct.pack("<Q3d3BdQ", i, *position, *color, 0.0, len(track) // 8) + track
        for i, (position, color, track) in enumerate(rows, 1)
    ]
