"""Read the three files of a COLMAP model, binary or text; damaged numbers are errors.

COLMAP 3.12 and later also write `rigs` and `frames`.  They are not needed: `images` still holds the composed
world-to-camera pose of every registered image (tests compare it with pycolmap on such folders).
"""

from pathlib import Path

from clsplat.errors import DataError
from clsplat.scene.colmap_binary import cameras_binary, images_binary, points_binary
from clsplat.scene.colmap_records import REMEDY, CameraRecord, ImageRecord
from clsplat.scene.colmap_text import cameras_text, images_text, points_text
from clsplat.scene.points import PointTable


def find_file(folder: Path, stem: str) -> Path | None:
    """Return `stem`.bin or else `stem`.txt in a folder, or None."""
    files = (folder / f"{stem}.bin", folder / f"{stem}.txt")
    return next((file for file in files if file.is_file()), None)


def read_cameras(folder: Path) -> dict[int, CameraRecord]:
    """Return the cameras of a model by their ids.  Raises DataError, as all here, for a damaged file."""
    file = _require_file(folder, "cameras")
    cameras: dict[int, CameraRecord] = {}
    for number, camera in cameras_binary(file) if file.suffix == ".bin" else cameras_text(file):
        if number in cameras:
            raise DataError(f"{camera.where}: a second camera {number}; expected different ids: {REMEDY}")
        cameras[number] = camera
    return cameras


def read_images(folder: Path) -> list[ImageRecord]:
    """Return the registered images of a model, in the order of the file."""
    file = _require_file(folder, "images")
    return list(images_binary(file) if file.suffix == ".bin" else images_text(file))


def read_point_table(folder: Path) -> PointTable | None:
    """Return the points of a model with their errors, or None when it has no such file."""
    file = find_file(folder, "points3D")
    if file is None:
        return None
    return points_binary(file) if file.suffix == ".bin" else points_text(file)


def _require_file(folder: Path, stem: str) -> Path:
    file = find_file(folder, stem)
    if file is None:
        raise DataError(f"{folder}: no {stem}.bin or {stem}.txt; {REMEDY}")
    return file
