"""Load the photograph of a view for training, and find masks in folders."""

import hashlib
import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, pluralize
from clsplat.scene.images import read_image, write_image
from clsplat.scene.scene import Scene
from clsplat.scene.view import View, load_image, load_mask


def load_photograph(
    view: View, background: tuple[float, float, float], undistorted: Path | None = None
) -> NDArray[np.uint8]:
    """Return RGB, [H, W, 3], or RGB and a mask of 0 and 1, [H, W, 4].

    undistorted: a folder that caches undistorted photographs.  Raises DataError like load_image.
    """
    if view.lens is None or undistorted is None:
        return _loaded(view, background)
    file = undistorted / f"{view.name}.{_key(view, background)}.png"
    try:
        return read_image(file).astype(np.uint8)
    except DataError:
        pixels = _loaded(view, background)
    write_image(file, pixels)
    return pixels


def _key(view: View, background: tuple[float, float, float]) -> str:
    """Return a hash of the file, the lens, the size, and the background of transparent pixels."""
    state = view.image_path.stat() if view.image_path.exists() else None
    file = state and (state.st_mtime_ns, state.st_size)
    parts = view.lens, view.camera, view.mask_path, view.alpha, background, file
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _loaded(view: View, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    pixels, mask = load_image(view, background), load_mask(view)
    return pixels if mask is None else np.dstack([pixels, mask.astype(np.uint8)])


LOG = logging.getLogger("clsplat")


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of an image: its name with .png appended (COLMAP) or as the suffix; None without one."""
    return next((file for file in _candidates(folder, name) if os.path.isfile(file)), None)  # never raises


def with_masks(scene: Scene, folder: Path | None) -> Scene:
    """Return the scene with the masks in a folder; without a folder, the scene.

    All pixels of a photograph without a mask are used.  Raises DataError if the folder does not exist or contains no
    mask of a photograph, and if the dataset already has masks.
    """
    if folder is None:
        return scene
    existing = next((view.mask_path for view in scene.views if view.mask_path), None)
    if existing is not None:
        raise DataError(
            f"{scene.path}: the dataset already has masks, such as {existing}; remove scene.masks, "
            "or the masks of the dataset"
        )
    views = tuple(replace(view, mask_path=find_mask(folder, view.name)) for view in scene.views)
    count, missing = len(views), [view.name for view in views if view.mask_path is None]
    if len(missing) == count:
        fault = f"contains no mask for the photographs of {scene.path}" if folder.is_dir() else "no such folder"
        names = " or ".join(str(file) for file in dict.fromkeys(reversed(_candidates(folder, missing[0]))))
        raise DataError(
            f"{folder}: {fault}; expected {names} for the first of {count}, white in pixels "
            "to use: rename the files, or set scene.masks to another folder"
        )
    if missing:
        masked = f"{count - len(missing)} of {pluralize(count, 'photograph')}"
        LOG.warning(
            "%s: contains masks for %s; all pixels of the others are used, such as %s", folder, masked, missing[0]
        )
    return replace(scene, views=views)


def _candidates(folder: Path, name: str) -> tuple[Path, Path]:
    return folder / f"{name}.png", (folder / name).with_suffix(".png")
