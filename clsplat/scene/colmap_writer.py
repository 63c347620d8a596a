"""COLMAP's model as binary files: cameras, images, and points with their tracks."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.files import open_atomic
from clsplat.core.quaternions import unit_quaternions
from clsplat.scene.camera import Lens
from clsplat.scene.colmap import MODELS, POINT2D
from clsplat.scene.reprojection import project_points
from clsplat.scene.scene import PointCloud, Tracks
from clsplat.scene.view import PosedView, View, photo_lens

MODEL = Path("sparse/0")  # the folder of the model, beside that of the images
FILES = ("cameras.bin", "images.bin", "points3D.bin")
EXACTLY = np.zeros((1, 2))  # where the camera shows a point


def write_colmap(out: Path, views: list[PosedView], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write the model into out/sparse/0; return its files.  Raises OutputError."""
    renamed = tracks and tracks.renamed({one.view.name: one.name for one in views})
    write_model(out / MODEL, [replace(one.view, name=one.name) for one in views], points, renamed)
    return [out / MODEL / name for name in FILES]


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None, tracks: Tracks | None = None) -> None:
    """Write `views`, whose names are those of their images, and points; lenses that are equal are one camera.

    tracks: which of the points, in their order, each view shows; their places in an image are where the camera projects
    them to, and as far from there as they were in the photograph.  Raises OutputError.
    """
    lenses = [photo_lens(view) for view in views]
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), 1)}
    shown = [_shown(points, view, tracks) for view in views]
    images = zip(views, lenses, shown, strict=True)
    rows = (
        [_camera(number, lens) for lens, number in numbers.items()],
        [_image(i, view, numbers[lens], table) for i, (view, lens, table) in enumerate(images, 1)],
        [] if points is None else _points(points, shown),
    )
    for name, records in zip(FILES, rows, strict=True):
        with open_atomic(folder / name) as file:
            file.write(struct.pack("<Q", len(records)) + b"".join(records))


def _camera(number: int, lens: Lens) -> bytes:
    head = struct.pack("<IiQQ", number, MODELS.index(lens.model), lens.width, lens.height)
    return head + struct.pack(f"<{len(lens.params)}d", *lens.params)


def _image(number: int, view: View, camera: int, shown: NDArray[Any]) -> bytes:
    quaternion = unit_quaternions(view.world_to_camera[:, :3])
    pose = struct.pack("<I7dI", number, *quaternion, *view.world_to_camera[:, 3], camera)
    return pose + view.name.encode() + b"\0" + struct.pack("<Q", len(shown)) + shown.tobytes()


def _shown(points: PointCloud | None, view: View, tracks: Tracks | None) -> NDArray[Any]:
    """The 2D points of a view: those of its track that lie before the camera."""
    if points is None or tracks is None or view.name not in tracks.seen:
        return np.zeros(0, POINT2D)
    rows, missed = tracks.seen[view.name], tracks.residuals.get(view.name, EXACTLY) / view.downscale
    places = project_points(view, points.positions[rows]) + np.nan_to_num(missed)
    known = np.isfinite(places).all(axis=1)
    table = np.zeros(np.count_nonzero(known), POINT2D)
    table["point"], table["xy"] = rows[known] + 1, places[known]
    return table


def _points(points: PointCloud, shown: Sequence[NDArray[Any]]) -> list[bytes]:
    """shown: the 2D points of each image, by its number less 1."""
    tracks: list[bytes] = [b""] * len(points)
    for number, table in enumerate(shown, 1):
        for place, point in enumerate(table["point"].tolist()):
            tracks[point - 1] += struct.pack("<II", number, place)
    rgb = np.rint(points.colors * 255).astype(np.uint8)
    rows = zip(points.positions.astype(float), rgb, tracks, strict=True)
    return [
        struct.pack("<Q3d3BdQ", i, *position, *color, 0.0, len(track) // 8) + track
        for i, (position, color, track) in enumerate(rows, 1)
    ]
