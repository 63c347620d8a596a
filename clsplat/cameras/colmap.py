"""COLMAP's model as text: cameras.txt, images.txt and points3D.txt, with the tracks of its points."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.cameras.posed import Posed
from clsplat.errors import DataError, quoted
from clsplat.files import write_text
from clsplat.quaternions import unit_quaternions
from clsplat.scene.lens import Lens
from clsplat.scene.reprojection import projected
from clsplat.scene.scene import PointCloud
from clsplat.scene.tracks import Tracks

MODEL = Path("sparse/0")  # the folder of the model, beside that of the images
EXACTLY = np.zeros((1, 2))  # where the camera shows a point


def write(out: Path, views: list[Posed], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write the model into out/sparse/0; return its files.  Raises OutputError."""
    seen = [_shown(one, tracks) if points and tracks else {} for one in views]
    lenses = {lens: number for number, lens in enumerate(dict.fromkeys(one.lens for one in views), 1)}
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", *(_camera(lens, number) for lens, number in lenses.items())]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[] as (X Y POINT3D_ID)"]
    for number, (one, places) in enumerate(zip(views, seen, strict=True), 1):
        shown = " ".join(f"{numbers(place)} {row + 1}" for row, place in places.items())
        images += [_image(one, number, lenses[one.lens]), shown]
    rows = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)"]
    rows += _points(points, seen) if points else []
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": rows}
    for name, lines in files.items():
        write_text(out / MODEL / name, "\n".join(lines) + "\n")
    return [out / MODEL / name for name in files]


def check(views: list[Posed]) -> None:
    """Raise DataError for a name that COLMAP reads another way."""
    for one in views:
        if " " in one.name:
            remedy = "rename the photographs, or write nerfstudio"
            raise DataError(f"{quoted(one.name)}: COLMAP reads a name up to its first blank; {remedy}")


def _camera(lens: Lens, number: int) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {numbers(lens.params)}"


def _image(one: Posed, number: int, camera: int) -> str:
    pose = one.view.world_to_camera
    quaternion = unit_quaternions(pose[:, :3])
    return f"{number} {numbers(quaternion)} {numbers(pose[:, 3])} {camera} {one.name}"


def _shown(one: Posed, tracks: Tracks) -> dict[int, NDArray[np.float64]]:
    """The rows of the points that a photograph shows, and the places where it does, [2] px."""
    name = one.view.name
    rows = tracks.seen.get(name, np.empty(0, np.int64))
    places = projected(one.view, tracks.positions[rows]) + tracks.misses.get(name, EXACTLY)
    return {int(row): place for row, place in zip(rows, places, strict=True) if np.isfinite(place).all()}


def _points(points: PointCloud, seen: list[dict[int, NDArray[np.float64]]]) -> list[str]:
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
