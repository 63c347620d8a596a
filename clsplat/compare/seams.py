"""What a model that was trained in blocks shows near their borders, beside the rest of the same views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.compare.run_folder import RunFolder
from clsplat.errors import DataError
from clsplat.metrics.perceptual import Image
from clsplat.names import SEAMS
from clsplat.scene.images import read_image
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import load_image
from clsplat.stages.render import image_path
from clsplat.views.photographs import BACKGROUNDS

TINT = np.array([255, 64, 64])  # of the band in the picture


@dataclass(frozen=True)
class Seams:
    """The bands along the borders of blocks in the views that all runs rendered."""

    share: float  # of the pixels of these views
    views: int
    band: list[float]  # dB, PSNR of the band over all views, by run
    rest: list[float]  # dB, of the other pixels
    view: str  # of the picture
    picture: Image  # the photograph, with the band


def find_seams(runs: Sequence[RunFolder], scene: Scene, background: Background) -> Seams | None:
    """Return the bands by the masks of the first run that has some; None where none has, or no view has a band.

    The other runs are measured in the same pixels, such as a whole beside its blocks.  Raises DataError when a file is
    damaged.
    """
    folder = next((run.path / SEAMS for run in runs if (run.path / SEAMS).is_dir()), None)
    if folder is None:
        return None
    pixels, errors = np.zeros(2), np.zeros((2, len(runs)))  # band and rest
    most, picture, shown, views = 0.0, None, "", 0
    for view in scene.views:
        renders = [image_path(run.renders, view.name) for run in runs]
        mask = image_path(folder, view.name)
        if not mask.is_file() or not all(path.is_file() for path in renders):
            continue
        photograph = load_image(view, BACKGROUNDS[background])
        band = _band(mask, photograph)
        views += 1
        for number, path in enumerate(renders):
            render = load_image(replace(view, image_path=path, lens=None))
            squared = ((render.astype(np.float64) - photograph) ** 2).mean(axis=2)
            errors[:, number] += squared[band].sum(), squared[~band].sum()
        pixels += band.sum(), (~band).sum()
        if band.mean() > most:
            most, shown = float(band.mean()), view.name
            picture = np.where(band[:, :, None], (photograph + TINT) / 2, photograph).astype(np.uint8)
    if picture is None or not pixels.all():
        return None
    near, others = ([_decibels(value / count) for value in row] for row, count in zip(errors, pixels, strict=True))
    return Seams(float(pixels[0] / pixels.sum()), views, near, others, shown, picture)


def _band(mask: Path, photograph: Image) -> NDArray[np.bool_]:
    """The pixels of a band, [H, W].  Raises DataError for a mask of another size than the photograph."""
    image = read_image(mask)
    (height, width), (high, wide) = image.shape[:2], photograph.shape[:2]
    if (height, width) != (high, wide):
        raise DataError(f"{mask}: is {width}x{height} px; expected {wide}x{high} as the photograph: remove the file")
    return np.asarray(image[:, :, 0] > 0)


def _decibels(error: float) -> float:
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)
