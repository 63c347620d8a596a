"""Crops of the views that all runs rendered, where the runs differ most, beside the photograph."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import SEAMS
from clsplat.metrics.images import psnr
from clsplat.metrics.perceptual import Image
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.runs.results import RunFolder
from clsplat.scene.images import read_image
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import View, load_image
from clsplat.stages.render import image_path

MIN_SIDE, MAX_SIDE = 48, 192  # px, of a crop: a third of the image within these limits
MAX_CROPS = 4  # of a scene, each of another view
OVERVIEW_WIDTH = 340  # px


@dataclass(frozen=True)
class ImageCrop:
    """A square of one view."""

    view: str
    whole_photograph: Image
    whole_renders: list[Image]  # by run
    x: int
    y: int
    side: int
    difference: float  # mean over the square, in grey levels

    @property
    def photograph(self) -> Image:
        """The square of the photograph."""
        return self._of(self.whole_photograph)

    @property
    def renders(self) -> list[Image]:
        """The square of each run's render."""
        return [self._of(image) for image in self.whole_renders]

    @property
    def psnrs(self) -> list[float]:
        """PSNR in the square, dB, by run."""
        return [psnr(render, self.photograph) for render in self.renders]

    @property
    def frame(self) -> dict[str, float]:
        """The square's left, top, width and height in percent of the image."""
        height, width = self.whole_photograph.shape[:2]
        parts = {
            "left": self.x / width,
            "top": self.y / height,
            "width": self.side / width,
            "height": self.side / height,
        }
        return {name: round(100 * part, 2) for name, part in parts.items()}

    @property
    def overview(self) -> Image:
        """The whole photograph, OVERVIEW_WIDTH wide."""
        height, width = self.whole_photograph.shape[:2]
        size = (OVERVIEW_WIDTH, max(1, round(OVERVIEW_WIDTH * height / width)))
        return cv2.resize(self.whole_photograph, size, interpolation=cv2.INTER_AREA).astype(np.uint8)

    def _of(self, image: Image) -> Image:
        return np.ascontiguousarray(image[self.y : self.y + self.side, self.x : self.x + self.side])


def find_crops(runs: Sequence[RunFolder], scene: Scene, background: Background) -> list[ImageCrop]:
    """Return crops of the views that all runs of one scene rendered, where the renders differ most.

    Raises DataError when a render or a photograph is damaged.
    """
    rendered = [view for view in scene.views if all(_file(run, view).is_file() for run in runs)]
    chosen: list[ImageCrop] = []  # these and one more view are in memory at a time
    for view in rendered:
        renders = [load_image(replace(view, image_path=_file(run, view), lens=None)) for run in runs]  # a pinhole's
        chosen.append(_crop(view.name, load_image(view, BACKGROUNDS[background]), renders))
        chosen = sorted(chosen, key=lambda crop: -crop.difference)[:MAX_CROPS]
    return chosen


def _file(run: RunFolder, view: View) -> Path:
    return image_path(run.renders, view.name)


def _crop(view: str, photograph: Image, renders: list[Image]) -> ImageCrop:
    """The crop in which the renders differ most from each other, or a single one from the photograph."""
    images = np.stack(renders if len(renders) > 1 else [*renders, photograph])
    difference = (images.max(axis=0) - images.min(axis=0)).mean(axis=2, dtype=np.float32)
    height, width = photograph.shape[:2]
    side = min(height, width, max(MIN_SIDE, min(MAX_SIDE, min(height, width) // 3)))
    means = cv2.boxFilter(difference, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    inside = means[: height - side + 1, : width - side + 1]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return ImageCrop(view, photograph, renders, int(x), int(y), side, float(inside.max()))


# What a model that was trained in blocks shows near their borders, beside the rest of the same views.

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
