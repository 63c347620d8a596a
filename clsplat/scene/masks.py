"""Masks that something else has made of the photographs, found in a folder by their names."""

import logging
import os
from dataclasses import replace
from pathlib import Path

from clsplat.errors import DataError, amount
from clsplat.scene.scene import Scene

LOG = logging.getLogger("clsplat")


def mask_file(folder: Path, name: str) -> Path | None:
    """Return the mask of an image by name: with .png appended (COLMAP), or in place of its suffix; None without one."""
    return next((file for file in _candidates(folder, name) if os.path.isfile(file)), None)  # never raises


def with_masks(scene: Scene, folder: Path | None) -> Scene:
    """Return the scene with the masks in a folder instead of its own; without a folder, the scene.

    A photograph without a mask counts whole.  Raises DataError where there is no such folder, and where no photograph
    has a mask.
    """
    if folder is None:
        return scene
    views = tuple(replace(view, mask_path=mask_file(folder, view.name)) for view in scene.views)
    count, missing = len(views), [view.name for view in views if view.mask_path is None]
    if len(missing) == count:
        fault = f"holds no mask of a photograph of {scene.path}" if folder.is_dir() else "no such folder"
        long, short = _candidates(folder, missing[0])
        raise DataError(
            f"{folder}: {fault}; expected {short} or {long} for the first of {count}, white in pixels "
            "that count: name the files so, or give another folder as scene.masks"
        )
    if missing:
        masked = f"{count - len(missing)} of {amount(count, 'photograph')}"
        LOG.warning("%s: has masks of %s; the others count whole, such as %s", folder, masked, missing[0])
    return replace(scene, views=views)


def _candidates(folder: Path, name: str) -> tuple[Path, Path]:
    return folder / f"{name}.png", (folder / name).with_suffix(".png")
