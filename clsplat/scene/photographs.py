"""Load the photograph of a view for training, and find masks in folders."""

import hashlib
import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, pluralize
from clsplat.scene.images import read_image, write_image
from clsplat.scene.lookup import FileLookup
from clsplat.scene.scene import Scene
from clsplat.scene.view import View, load_image, load_mask, photograph_name


def load_photograph(
    view: View, background: tuple[float, float, float], undistorted: Path | None = None
) -> NDArray[np.uint8]:
    """Return the photograph of a view: RGB, [H, W, 3], or RGB and a mask of 0 and 1, [H, W, 4].

    background: a color in [0, 1] behind transparent pixels.  undistorted: a folder that caches undistorted photographs.
    Raises DataError like load_image.
    """
    if view.lens is None or undistorted is None or view.image is not None:
        return _load(view, background)
    file = undistorted / f"{view.name}.{_cache_key(view, background)}.png"
    try:
        return read_image(file).astype(np.uint8)
    except DataError:
        pixels = _load(view, background)
    write_image(file, pixels)
    return pixels


def _cache_key(view: View, background: tuple[float, float, float]) -> str:
    """Return a hash of everything that the cached photograph depends on: file, lens, size, mask and background."""
    state = view.image_path.stat() if view.image_path.exists() else None
    file_stamp = state and (state.st_mtime_ns, state.st_size)
    parts = view.lens, view.camera, view.mask_path, view.alpha, background, file_stamp
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _load(view: View, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    pixels, mask = load_image(view, background), load_mask(view)
    return pixels if mask is None else np.dstack([pixels, mask.astype(np.uint8)])


LOG = logging.getLogger("clsplat")


def find_masks(folder: Path, names: Sequence[str]) -> list[Path | None]:
    """Return the mask file of each image, `NAME.jpg.png` (as in COLMAP) or `NAME.png`; None without a mask."""
    if not folder.is_dir():
        return [None] * len(names)
    files = FileLookup(folder, folder, names, _mask_names, strict=True)
    return [file if os.path.isfile(file) else None for file in files.paths]  # unlike Path.is_file, never raises


def with_masks(scene: Scene, folder: Path | None) -> Scene:
    """Return the scene with the masks in `folder`, or the scene itself if `folder` is None.

    All pixels of a photograph without a mask are used.  Faces of a wide photograph that its mask hides are omitted.
    Raises DataError if the folder does not exist or contains no mask for any photograph, or if the dataset already has
    masks.
    """
    if folder is None:
        return scene
    existing_mask = next((view.mask_path for view in scene.views if view.mask_path), None)
    if existing_mask is not None:
        raise DataError(
            f"{scene.path}: the dataset already has masks, such as {existing_mask}; remove scene.masks, "
            "or the masks of the dataset"
        )
    photographs = [view.name if view.lens is None else photograph_name(view.name) for view in scene.views]
    masks = find_masks(folder, photographs)
    views = tuple(replace(view, mask_path=mask) for view, mask in zip(scene.views, masks, strict=True))
    masks_by_name = dict(zip(photographs, masks, strict=True))
    count, missing_names = len(masks_by_name), [name for name, mask in masks_by_name.items() if mask is None]
    if len(missing_names) == count:
        fault = f"contains no mask for the photos of {scene.path}" if folder.is_dir() else "no such folder"
        names = " or ".join(str(folder / file) for file in reversed(_mask_names(missing_names[0])))
        raise DataError(
            f"{folder}: {fault}; expected {names} for the first of {count} photos, "
            "with white for usable pixels: rename the files, or set scene.masks to another folder"
        )
    if missing_names:
        photos = f"{count - len(missing_names)} of {pluralize(count, 'photo')}"
        LOG.warning(
            "%s: contains masks for %s; all pixels of the other photos, such as %s, are used",
            folder,
            photos,
            missing_names[0],
        )
    return _without_hidden_faces(replace(scene, views=views))


def _without_hidden_faces(scene: Scene) -> Scene:
    read_mask = lru_cache(1)(read_image)
    visible = [
        i
        for i, (mask, lens) in enumerate((view.mask_path, view.lens) for view in scene.views)
        if mask is None or lens is None or not lens.face or lens.shows_white(read_mask(mask))
    ]
    new_index = {old: i for i, old in enumerate(visible)}
    train, test, validation = (tuple(new_index[i] for i in split if i in new_index) for split in scene.indices.values())
    views = tuple(scene.views[i] for i in visible)
    return replace(scene, views=views, train=train, test=test, validation=validation)


def _mask_names(name: str) -> list[str]:
    return list(dict.fromkeys((f"{name}.png", str(PurePosixPath(name).with_suffix(".png")))))
