"""COLMAP's model, as text and as binary files: cameras, images, and points with their tracks."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quoted
from clsplat.core.files import atomic, write_text
from clsplat.core.quaternions import unit_quaternions
from clsplat.scene.camera import Camera, Lens
from clsplat.scene.colmap import POINT2D
from clsplat.scene.reprojection import projected
from clsplat.scene.scene import PointCloud, Tracks
from clsplat.scene.view import Posed, View

# Text: cameras.txt, images.txt and points3D.txt, with the tracks of the points.

MODEL = Path("sparse/0")  # the folder of the model, beside that of the images
EXACTLY = np.zeros((1, 2))  # where the camera shows a point


def write_colmap(out: Path, views: list[Posed], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write the model into out/sparse/0; return its files.  Raises OutputError."""
    seen = [_places(one, tracks) if points and tracks else {} for one in views]
    lenses = {lens: number for number, lens in enumerate(dict.fromkeys(one.lens for one in views), 1)}
    cameras = [
        "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
        *(_text_camera(lens, number) for lens, number in lenses.items()),
    ]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[] as (X Y POINT3D_ID)"]
    for number, (one, places) in enumerate(zip(views, seen, strict=True), 1):
        shown = " ".join(f"{numbers(place)} {row + 1}" for row, place in places.items())
        images += [_text_image(one, number, lenses[one.lens]), shown]
    rows = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)"]
    rows += _text_points(points, seen) if points else []
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": rows}
    for name, lines in files.items():
        write_text(out / MODEL / name, "\n".join(lines) + "\n")
    return [out / MODEL / name for name in files]


def check_colmap(views: list[Posed]) -> None:
    """Raise DataError for a name that COLMAP reads another way."""
    for one in views:
        if " " in one.name:
            remedy = "rename the photographs, or write nerfstudio"
            raise DataError(f"{quoted(one.name)}: COLMAP reads a name up to its first blank; {remedy}")


def _text_camera(lens: Lens, number: int) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {numbers(lens.params)}"


def _text_image(one: Posed, number: int, camera: int) -> str:
    pose = one.view.world_to_camera
    quaternion = unit_quaternions(pose[:, :3])
    return f"{number} {numbers(quaternion)} {numbers(pose[:, 3])} {camera} {one.name}"


def _places(one: Posed, tracks: Tracks) -> dict[int, NDArray[np.float64]]:
    """The rows of the points that a photograph shows, and the places where it does, [2] px."""
    name = one.view.name
    rows = tracks.seen.get(name, np.empty(0, np.int64))
    places = projected(one.view, tracks.positions[rows]) + tracks.misses.get(name, EXACTLY)
    return {int(row): place for row, place in zip(rows, places, strict=True) if np.isfinite(place).all()}


def _text_points(points: PointCloud, seen: list[dict[int, NDArray[np.float64]]]) -> list[str]:
    tracks: list[list[str]] = [[] for _ in range(len(points))]
    for number, places in enumerate(seen, 1):
        for at, row in enumerate(places):
            tracks[row].append(f" {number} {at}")
    rgb = np.rint(points.colours * 255).astype(int).tolist()
    places = points.positions.astype(float).tolist()
    return [
        f"{number} {numbers(place)} {colour[0]} {colour[1]} {colour[2]} 0{''.join(track)}"
        for number, (place, colour, track) in enumerate(zip(places, rgb, tracks, strict=True), 1)
    ]


def numbers(values: object) -> str:
    """Return numbers with all digits that tell them apart."""
    return " ".join(repr(float(value)) for value in values)  # type: ignore[attr-defined]


# Binary files of pinhole cameras: cameras.bin, images.bin, points3D.bin.

PINHOLE = 1  # COLMAP's number of the model
NONE = np.empty(0, np.int64)


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None, tracks: Tracks | None = None) -> None:
    """Write `views`, whose names are those of their images, and points; cameras that are equal are one.

    tracks: which of the points, in their order, each view shows; their places in an image are where the camera projects
    them to, and as far from there as they were in the photograph.  Raises OutputError.
    """
    cameras: dict[Camera, int] = {}
    for view in views:
        cameras.setdefault(view.camera, len(cameras) + 1)
    seen = {view.name: tracks.seen.get(view.name, NONE) if tracks and points else NONE for view in views}
    rows = [_binary_camera(number, camera) for camera, number in cameras.items()]
    _write_binary(folder / "cameras.bin", rows)
    missed = {
        view.name: tracks.misses.get(view.name, EXACTLY) / view.downscale if tracks else EXACTLY for view in views
    }
    images = [
        _binary_image(i, view, cameras[view.camera], _shown(points, seen[view.name], view, missed[view.name]))
        for i, view in enumerate(views, 1)
    ]
    _write_binary(folder / "images.bin", images)
    _write_binary(folder / "points3D.bin", [] if points is None else _binary_points(points, list(seen.values())))


def _write_binary(path: Path, rows: Sequence[bytes]) -> None:
    with atomic(path) as file:
        file.write(struct.pack("<Q", len(rows)) + b"".join(rows))


def _binary_camera(number: int, camera: Camera) -> bytes:
    params = camera.fx, camera.fy, camera.cx, camera.cy
    return struct.pack("<IiQQ4d", number, PINHOLE, camera.width, camera.height, *params)


def _binary_image(number: int, view: View, camera: int, shown: NDArray[Any]) -> bytes:
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


def _binary_points(points: PointCloud, seen: Sequence[NDArray[np.int64]]) -> list[bytes]:
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
