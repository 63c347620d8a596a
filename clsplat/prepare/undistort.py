"""Convert a scene to pinhole cameras: undistort its photographs, and optionally downscale them."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from clsplat.core.errors import DataError
from clsplat.core.manifest import Manifest, hash_values
from clsplat.core.progress import ItemCounter
from clsplat.scene.camera import intern_lens
from clsplat.scene.colmap_writer import write_colmap
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_exposures, write_image
from clsplat.scene.times_file import write_times
from clsplat.scene.view import View, load_exposures, load_image, load_mask

UndefinedPixels = Literal["crop", "mask"]


def undistort_scene(
    source: Path, out: Path, long_side: int | None = None, undefined_pixels: UndefinedPixels = "crop"
) -> int:
    """Write a COLMAP scene of pinhole cameras to the folder `out`, and return the number of its images.

    Photographs larger than `long_side` px are downscaled.  `undefined_pixels: crop` keeps the largest part of a
    photograph without undefined pixels; `mask` keeps the entire photograph, and writes masks of its undefined pixels.
    Images that an earlier call made from the same photographs with the same settings stay unchanged.
    Raises DataError when the scene cannot be read, or when `out` contains other images.
    """
    scene = read_scene(source, holdout=0)
    names, manifest = _png_names([view.name for view in scene.views]), Manifest(out)
    for name in names:
        manifest.require_listed(out / "images" / name)
    views, counter = [], ItemCounter("photos undistorted", len(names))
    for i, (view, name) in enumerate(zip(scene.views, names, strict=True), 1):
        pinhole_view = replace(_downscale(_with_lens(view, undefined_pixels), long_side), alpha="mask")
        image_path, mask_path = out / "images" / name, out / "masks" / name
        if manifest.needs_writing(image_path, _source_hash(pinhole_view), mask_path):
            is_valid = load_mask(pinhole_view)
            if is_valid is not None and not is_valid.all():
                write_image(mask_path, np.repeat(np.where(is_valid, 255, 0).astype(np.uint8)[:, :, None], 3, axis=2))
            write_image(image_path, load_image(pinhole_view))
        views.append(replace(pinhole_view, lens=None))
        counter.reach(i)
    write_exposures(out / "images", dict(zip(names, load_exposures(scene.views), strict=True)))
    if times := {name: view.time for view, name in zip(scene.views, names, strict=True) if view.time is not None}:
        write_times(out / "images", times)
    write_colmap(out, replace(scene, views=tuple(views)).renamed(names).in_world())
    return len(views)


def _source_hash(view: View) -> str:
    """Return a hash of all inputs of an undistorted image and its mask."""
    files = [view.image_path, *([view.mask_path] if view.mask_path else [])]
    return hash_values(*files, view.lens, view.camera)


def _with_lens(view: View, undefined_pixels: UndefinedPixels) -> View:
    if view.lens is None or undefined_pixels == "crop":
        return view
    lens = intern_lens(replace(view.lens, keep_border=True))
    return replace(view, lens=lens, camera=lens.pinhole)


def _downscale(view: View, long_side: int | None) -> View:
    """Return the view at a size whose longer side is at most `long_side` px."""
    longest = max(view.camera.width, view.camera.height)
    return view if long_side is None else view.resized(max(1.0, longest / long_side))


def _png_names(names: list[str]) -> list[str]:
    """Return the names with the suffix replaced by .png.  Names that would become equal get .png appended instead."""
    candidates = [Path(name).with_suffix(".png").as_posix() for name in names]
    counts = Counter(candidates)
    unique_names = [png if counts[png] == 1 else f"{name}.png" for png, name in zip(candidates, names, strict=True)]
    if len(set(unique_names)) < len(unique_names):
        raise DataError(f"two images would be named '{Counter(unique_names).most_common(1)[0][0]}'; rename one")
    return unique_names
