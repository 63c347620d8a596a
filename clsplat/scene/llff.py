"""Read LLFF datasets: `poses_bounds.npy` next to a folder of photographs (Mildenhall et al. 2019)."""

import io
import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, one_line
from clsplat.core.reading import read_file
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Camera
from clsplat.scene.images import is_image, read_header
from clsplat.scene.points import MAX_VALUE
from clsplat.scene.reader import Parts, Reader
from clsplat.scene.scene import Scene, every_nth, make_scene
from clsplat.scene.view import View

POSES_FILE = "poses_bounds.npy"
MAX_BYTES = 1 << 24  # 120,000 images of 136 bytes each
LLFF_TO_OPENCV = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float64)  # LLFF's axes are (down, right, back)
logger = logging.getLogger("clsplat")


class LlffReader(Reader):
    """Read an LLFF scene: the i-th row of `poses_bounds.npy` belongs to the i-th image in order of name.

    The file contains focal lengths, but no distortion and no points.  Every `holdout`-th view is a test view.
    """

    name = "LLFF"
    expects = POSES_FILE

    def read(self, path: Path, holdout: int) -> Scene:
        file = path / POSES_FILE
        rows, images = read_poses(file), find_image_files(path)
        if len(rows) != len(images):
            raise DataError(
                f"{file}: has {len(rows)} poses for {len(images)} images in {images[0].parent if images else path}; "
                "expected one pose per image, by name: add the missing images or remove the extra ones"
            )
        views = [view_from_row(file, row, image) for row, image in zip(rows, images, strict=True)]
        logger.info(
            "%s: LLFF stores one focal length per image and no distortion; the photos must be undistorted", file
        )
        return make_scene(path, views, every_nth([view.name for view in views], holdout), None)

    def list_parts(self, parts: Parts) -> None:
        super().list_parts(parts)
        parts.disk_files = find_image_files(parts.path)


def read_poses(path: Path) -> NDArray[np.float64]:
    """Return the rows of a `poses_bounds.npy` file, [N, 17]: a flattened [3, 5] matrix, and the depth range.

    Raises DataError for a damaged file and for values that are not finite.
    """
    data = read_file(path, "a NumPy file", limit=MAX_BYTES)
    try:
        rows = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
            raise ValueError(f"it has shape {rows.shape}, {rows.dtype}")
        if not (np.abs(rows) < MAX_VALUE).all():
            raise ValueError(f"it has numbers that are not finite, or beyond {MAX_VALUE:g}")
    except Exception as error:  # NumPy evaluates the header as Python, which may raise any exception
        raise DataError(f"{path}: {one_line(error)}; expected finite numbers [N, 17]: export it again") from error
    return np.asarray(rows, np.float64)


def find_image_files(path: Path) -> list[Path]:
    """Return the image files of a dataset, sorted by name.

    They are in the first folder that contains images: `images`, `input`, `images_N` in ascending order of N, or `path`
    itself.  The list is empty if there is no such folder.
    """
    small_folders = [folder for folder in path.glob("images_*") if re.fullmatch(r"images_\d+", folder.name)]
    for folder in (path / "images", path / "input", *sorted(small_folders, key=lambda f: int(f.name[7:])), path):
        files = sorted(file for file in folder.iterdir() if is_image(file)) if folder.is_dir() else []
        if files:
            return files
    return []


def view_from_row(path: Path, row: NDArray[np.float64], image: Path) -> View:
    """Return the view of a row of the file `path`, with its focal length scaled to the size of the image.

    Raises DataError for an invalid camera or pose, or for an image with another aspect ratio.
    """
    matrix, header = row[:15].reshape(3, 5), read_header(image)
    height, width, focal = matrix[:, 4]
    scale = header.width / max(width, 1.0)
    if not (1 <= width <= MAX_SIDE and 0 < height <= MAX_SIDE and focal * scale >= MIN_FOCAL):
        raise DataError(
            f"{path}: {image.name}: invalid camera, {width:g} x {height:g} px, focal length {focal:g}; export it again"
        )
    if abs(header.height - height * scale) > 1.5:  # a resized image is rounded to whole pixels
        raise DataError(
            f"{path}: {image.name} is {header.width} x {header.height} px, its camera {width:g} x {height:g}; "
            "expected the same aspect ratio: use the images that the cameras were calibrated on"
        )
    rotation = matrix[:, :3] @ LLFF_TO_OPENCV
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise DataError(f"{path}: the 3x3 part of the pose of {image.name} is not a rotation; export the file again")
    camera_to_world = np.vstack([np.hstack([rotation, matrix[:, 3:4]]), [0, 0, 0, 1]])
    camera = Camera(header.width, header.height, focal * scale, focal * scale, header.width / 2, header.height / 2)
    return View(image.name, camera, np.linalg.inv(camera_to_world)[:3], image, camera_to_world=camera_to_world)
