"""Read COLMAP folders: choose the model, find the photographs, make pinhole cameras."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted
from clsplat.quaternions import rotation_matrix
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL
from clsplat.scene.colmap_files import find_file, read_cameras, read_images, read_point_table
from clsplat.scene.colmap_records import REMEDY, CameraRecord, ImageRecord
from clsplat.scene.images import inside, present
from clsplat.scene.lens import MODELS, Lens, shared
from clsplat.scene.masks import mask_file
from clsplat.scene.parts import Parts
from clsplat.scene.points import MAX_VALUE, PointTable
from clsplat.scene.readers import Reader
from clsplat.scene.reprojection import misses
from clsplat.scene.scene import PointCloud, Scene, View, every_nth, make_scene
from clsplat.scene.times_file import timed
from clsplat.scene.tracks import Tracks

logger = logging.getLogger("clsplat")


class ColmapReader(Reader):
    """A COLMAP scene: models in `sparse/N`, `sparse` or the folder itself, photographs in `images`.

    Of several models the reader takes the one with most images.  Every `holdout`-th view by name is for testing.
    Photographs of cameras with distortion are undistorted when they are read.  Masks lie in the folder
    `masks`: their names are those of the images with .png appended, or in place of the suffix.  With a file
    `images/times.json`, a number for each image by name, the scene moves.
    """

    name = "COLMAP"
    expects = "sparse/0/cameras.bin or .txt"

    def matches(self, path: Path) -> bool:
        return bool(find_models(path))

    def read(self, path: Path, holdout: int) -> Scene:
        model, images = _largest_model(path)
        cameras = read_cameras(model)
        folder = image_folder(path)
        views = sorted((view_of(image, cameras, folder) for image in images), key=lambda view: view.name)
        there = present(path, [view.image_path for view in views], self.missing)
        skipped = tuple(view.name for view, found in zip(views, there, strict=True) if not found)
        views = timed([view for view, found in zip(views, there, strict=True) if found], folder)
        table = read_point_table(model)
        points, tracks = (table.cloud(), tracks_of(images, table, views)) if table else (None, None)
        scene = make_scene(path, views, every_nth([view.name for view in views], holdout), points)
        return replace(scene, tracks=tracks, skipped=skipped)

    def list_parts(self, parts: Parts) -> None:
        found = [(folder, parts.attempt(read_images, folder) or []) for folder in find_models(parts.path)]
        found.sort(key=lambda model: -len(model[1]))  # `read` takes the first of the largest, and sorting is stable
        parts.submodels = {str(folder.relative_to(parts.path)): len(images) for folder, images in found}
        model, images = found[0]
        cameras = parts.attempt(read_cameras, model)
        parts.points = parts.attempt(read_point_table, model)
        parts.image_folder = folder = image_folder(parts.path)
        files = [parts.attempt(inside, folder, image.name, image.where) for image in images]
        parts.expected = [file for file in files if file]
        for image in images if cameras else []:
            if view := parts.attempt(view_of, image, cameras, folder):
                parts.views.append(view)
                parts.models[view.name] = cameras[image.camera].model if cameras else ""
                parts.observed[view.name] = image.observed


def camera_views(path: Path) -> tuple[list[View], PointCloud | None]:
    """Return a view for each image of the largest model, whether or not its file exists, and the points."""
    model, images = _largest_model(path)
    cameras, folder, table = read_cameras(model), image_folder(path), read_point_table(model)
    return [view_of(image, cameras, folder) for image in images], table.cloud() if table else None


def tracks_of(images: Sequence[ImageRecord], table: PointTable, views: Sequence[View] = ()) -> Tracks | None:
    """Return which points each image shows, or None where no image names one; of `views` how far from their places."""
    kept = table.kept()
    positions, ids = table.positions[kept], table.ids[kept]
    order = np.argsort(ids, kind="stable")
    seen, missed, by_name = {}, {}, {view.name: view for view in views}
    for image in images:
        named, first = np.unique(image.points, return_index=True)
        place = np.minimum(np.searchsorted(ids[order], named), max(len(ids) - 1, 0))
        known = ids[order][place] == named if len(ids) else np.zeros(len(named), bool)
        rows = seen[image.name] = order[place[known]] if len(ids) else np.empty(0, np.int64)
        if len(rows) and len(image.places) and image.name in by_name:
            missed[image.name] = misses(by_name[image.name], positions[rows], image.places[first[known]])
    return Tracks(positions, seen, missed) if any(map(len, seen.values())) else None


def find_models(path: Path) -> list[Path]:
    """Return the folders at or below `path` that hold a COLMAP model, by name."""
    sparse = path / "sparse"
    folders = [path, sparse, *(sorted(sparse.iterdir()) if sparse.is_dir() else [])]
    return [folder for folder in folders if find_file(folder, "cameras") and find_file(folder, "images")]


def _largest_model(path: Path) -> tuple[Path, list[ImageRecord]]:
    models = [(folder, read_images(folder)) for folder in find_models(path)]
    if not models:
        raise DataError(f"{path}: no COLMAP model; expected cameras and images (.bin or .txt) in sparse/0, sparse or .")
    best = max(models, key=lambda model: len(model[1]))
    others = ", ".join(f"{folder} ({len(images)})" for folder, images in models if folder != best[0])
    logger.info("%s: %d images%s", best[0], len(best[1]), f"; left out the smaller models {others}" if others else "")
    return best


def image_folder(path: Path) -> Path:
    """Return `images` beside `sparse` when `path` is `sparse` or one of its models, else `images` in `path`."""
    return next((folder.parent for folder in (path, path.parent) if folder.name == "sparse"), path) / "images"


def view_of(image: ImageRecord, cameras: dict[int, CameraRecord], folder: Path) -> View:
    """Check one image and its camera.  Raises DataError."""
    image_path = inside(folder, image.name, image.where)
    if image.camera not in cameras:
        raise DataError(
            f"{image.where}: image {quoted(image.name)} names camera {image.camera}; expected one of the cameras file, "
            f"{sorted(cameras)[:8]}: {REMEDY}"
        )
    try:
        pose = pose_matrix(image.quaternion, image.translation)
    except ValueError as error:
        raise DataError(
            f"{image.where}: the pose of {quoted(image.name)} is {error}: remove that image or {REMEDY}"
        ) from error
    lens = shared(_lens(image.camera, cameras[image.camera]))
    camera, distortion = (lens.pinhole, lens) if lens.distorts else (lens.camera, None)
    return View(image.name, camera, pose, image_path, mask_file(folder.with_name("masks"), image.name), lens=distortion)


def _lens(number: int, camera: CameraRecord) -> Lens:
    """Check a camera.  Raises DataError for models that are not supported, and for invalid numbers."""
    if camera.model not in MODELS:
        raise DataError(
            f"{camera.where}: camera {number} is {camera.model}; expected one of {', '.join(MODELS)}: "
            "undistort the images first with `colmap image_undistorter`"
        )
    sizes = camera.width, camera.height
    valid = min(sizes) > 0 and max(sizes) <= MAX_SIDE and min(camera.params[: MODELS[camera.model][0]]) >= MIN_FOCAL
    if not valid or not all(abs(value) < MAX_VALUE for value in camera.params):
        raise DataError(
            f"{camera.where}: camera {number} is {camera.width}x{camera.height} with parameters "
            f"{quoted(camera.params)}; expected a positive size of at most {MAX_SIDE}, focal lengths from "
            f"{MIN_FOCAL:g} on and finite numbers: {REMEDY}"
        )
    return Lens(camera.width, camera.height, camera.model, camera.params)


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose [3, 4] of a quaternion of any length but zero and a translation in scene units.

    Raises ValueError when numbers are missing or not finite, or the quaternion is zero.
    """
    length = math.hypot(*quaternion)
    sizes = len(quaternion), len(translation)
    if sizes != (4, 3) or not 0 < length < math.inf or not all(abs(part) < MAX_VALUE for part in translation):
        raise ValueError(
            f"quaternion {quoted(tuple(quaternion))}, translation {quoted(tuple(translation))}; "
            "expected finite numbers and a rotation"
        )
    return np.column_stack([rotation_matrix(*(part / length for part in quaternion)), translation])
