"""Masks for a scene's photographs: from their alpha, or from a folder of existing masks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.manifest import Manifest, hash_values
from clsplat.core.progress import Count
from clsplat.scene.colmap import ColmapReader, image_folder
from clsplat.scene.detect import find_reader, read_scene
from clsplat.scene.images import read_image, write_image
from clsplat.scene.photographs import find_mask
from clsplat.scene.view import View, load_mask

MIN_ALPHA = 0.5  # of the largest value


def write_masks(scene: Path, folder: Path | None = None, out: Path | None = None, threshold: float = MIN_ALPHA) -> int:
    """Write a mask for every photograph into `masks` beside `images`, or `out`; return the number written.

    A mask is white in pixels that count: those of its file in `folder` (NAME.png, or STEM.png), else those whose alpha
    is at least `threshold`, in [0, 1].  Masks that exist stay unchanged, unless an earlier call has made
    them of others.
    Raises DataError when a mask is missing or of another size than its photograph, a photograph has no alpha, or the
    scene's layout reads no folder of masks and `out` is None.
    """
    views = read_scene(scene, holdout=0).views
    target = out or _place(scene)
    sources = [None if folder is None else find_mask(folder, view.name) for view in views]
    missing = [view.name for view, source in zip(views, sources, strict=True) if folder and source is None]
    if missing:
        raise DataError(
            f"{folder}: has no masks for {len(missing)} of {len(views)} photographs: {', '.join(missing[:3])}; "
            "expected the photograph's name with .png appended, or in place of its suffix"
        )
    written, count = 0, Count("masks written", len(views))
    made = Manifest(target)
    for number, (view, source) in enumerate(zip(views, sources, strict=True), 1):
        path = target / Path(view.name).with_suffix(".png")
        if made.needs_writing(path, hash_values(view.image_path, threshold) if source is None else hash_values(source)):
            white = _from_alpha(view, threshold) if source is None else _from_file(view, source)
            write_image(path, np.repeat(np.where(white, 255, 0).astype(np.uint8)[:, :, None], 3, axis=2))
            written += 1
        count.reach(number)
    return written


def _place(scene: Path) -> Path:
    """The folder of masks that the reader of a scene looks into.  Raises DataError where it looks into none."""
    reader = find_reader(scene)
    if reader is not None and not isinstance(reader, ColmapReader):
        raise DataError(
            f"{scene}: {reader.name} scenes have no folder of masks; train with `--set scene.alpha=mask` to take the "
            "alpha as mask, or give --out, and train with that folder as `--set scene.masks=FOLDER`"
        )
    return image_folder(scene).with_name("masks")


def _from_alpha(view: View, threshold: float) -> NDArray[np.bool_]:
    pixels = read_image(view.image_path)
    if pixels.shape[2] < 4:
        raise DataError(f"{view.image_path}: has no alpha; expected RGBA, or give the folder that holds the masks")
    return np.asarray(pixels[:, :, 3] >= threshold * np.iinfo(pixels.dtype).max)


def _from_file(view: View, source: Path) -> NDArray[np.bool_]:
    """Which pixels are white in a mask file.  Raises DataError when it does not fit its photograph."""
    load_mask(replace(view, mask_path=source))
    pixels = read_image(source)
    return np.asarray(pixels[:, :, 0] >= MIN_ALPHA * np.iinfo(pixels.dtype).max)
