"""The photograph of a view for training: its colors and its mask."""

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
    """Return RGB, [H, W, 3], or with a mask RGB and 0 or 1, [H, W, 4].

    The folder `undistorted` keeps undistorted photographs, so that each is undistorted once.
    Raises DataError as load_image does.
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
    """A hash of the file, the lens, the size, and what is behind transparent pixels."""
    state = view.image_path.stat() if view.image_path.exists() else None
    file = state and (state.st_mtime_ns, state.st_size)
    parts = view.lens, view.camera, view.mask_path, view.alpha, background, file
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _loaded(view: View, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    pixels, mask = load_image(view, background), load_mask(view)
    return pixels if mask is None else np.dstack([pixels, mask.astype(np.uint8)])


# Masks that something else has made of the photographs, found in a folder by their names.

LOG = logging.getLogger("clsplat")


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of an image by name: with .png appended (COLMAP), or in place of its suffix; None without one."""
    return next((file for file in _candidates(folder, name) if os.path.isfile(file)), None)  # never raises


def with_masks(scene: Scene, folder: Path | None) -> Scene:
    """Return the scene with the masks in a folder; without a folder, the scene.

    A photograph without a mask counts whole.  Raises DataError where there is no such folder, where no photograph has a
    mask there, and where the dataset has masks already.
    """
    if folder is None:
        return scene
    own = next((view.mask_path for view in scene.views if view.mask_path), None)
    if own is not None:
        raise DataError(
            f"{scene.path}: has masks of its own, such as {own}; expected a dataset without any beside scene.masks: "
            "leave scene.masks out, or take those of the dataset away"
        )
    views = tuple(replace(view, mask_path=find_mask(folder, view.name)) for view in scene.views)
    count, missing = len(views), [view.name for view in views if view.mask_path is None]
    if len(missing) == count:
        fault = f"holds no mask of a photograph of {scene.path}" if folder.is_dir() else "no such folder"
        names = " or ".join(str(file) for file in dict.fromkeys(reversed(_candidates(folder, missing[0]))))
        raise DataError(
            f"{folder}: {fault}; expected {names} for the first of {count}, white in pixels "
            "that count: name the files so, or give another folder as scene.masks"
        )
    if missing:
        masked = f"{count - len(missing)} of {pluralize(count, 'photograph')}"
        LOG.warning("%s: has masks of %s; the others count whole, such as %s", folder, masked, missing[0])
    return replace(scene, views=views)


def _candidates(folder: Path, name: str) -> tuple[Path, Path]:
    return folder / f"{name}.png", (folder / name).with_suffix(".png")
