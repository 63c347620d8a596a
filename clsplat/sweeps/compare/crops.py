"""Find the crops in which the renders of runs differ most."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from clsplat.metrics.images import psnr
from clsplat.metrics.perceptual import Image
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.runs.results import RunFolder
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import View, load_image
from clsplat.stages.render import image_path

MIN_SIDE, MAX_SIDE = 48, 192  # px; a crop's side is a third of the shorter image side, within these limits
MAX_CROPS = 4  # per scene, each from a different view
OVERVIEW_WIDTH = 340  # px


@dataclass(frozen=True)
class ImageCrop:
    """A square crop of a view: the same pixels of its photo and of each run's render."""

    view: str  # name
    full_photograph: Image
    full_renders: list[Image]  # one per run
    x: int
    y: int
    side: int
    difference: float  # mean over the crop, in 8-bit levels

    @property
    def photograph(self) -> Image:
        """The crop from the photo."""
        return self._cut_out(self.full_photograph)

    @property
    def renders(self) -> list[Image]:
        """The crop from each run's render."""
        return [self._cut_out(image) for image in self.full_renders]

    @property
    def psnrs(self) -> list[float]:
        """The PSNR of the crop, dB, for each run."""
        return [psnr(render, self.photograph) for render in self.renders]

    @property
    def percentages(self) -> dict[str, float]:
        """The left, top, width, and height of the crop, as percentages of the image size."""
        height, width = self.full_photograph.shape[:2]
        fractions = {
            "left": self.x / width,
            "top": self.y / height,
            "width": self.side / width,
            "height": self.side / height,
        }
        return {name: round(100 * fraction, 2) for name, fraction in fractions.items()}

    @property
    def overview(self) -> Image:
        """The full photo, resized to a width of OVERVIEW_WIDTH."""
        height, width = self.full_photograph.shape[:2]
        size = (OVERVIEW_WIDTH, max(1, round(OVERVIEW_WIDTH * height / width)))
        return cv2.resize(self.full_photograph, size, interpolation=cv2.INTER_AREA).astype(np.uint8)

    def _cut_out(self, image: Image) -> Image:
        return np.ascontiguousarray(image[self.y : self.y + self.side, self.x : self.x + self.side])


def find_crops(runs: Sequence[RunFolder], scene: Scene, background: Background) -> list[ImageCrop]:
    """Return the crops in which the renders of a scene differ most, from views that all runs rendered.

    Raises DataError if a render or a photo is damaged.
    """
    rendered_views = [view for view in scene.views if all(_file(run, view).is_file() for run in runs)]
    crops: list[ImageCrop] = []  # images of at most MAX_CROPS + 1 views are in memory
    for view in rendered_views:
        renders = [load_image(replace(view, image_path=_file(run, view), lens=None)) for run in runs]  # undistorted
        crops.append(_crop(view.name, load_image(view, BACKGROUNDS[background]), renders))
        crops = sorted(crops, key=lambda crop: -crop.difference)[:MAX_CROPS]
    return crops


def _file(run: RunFolder, view: View) -> Path:
    return image_path(run.render_folder, view.name)


def _crop(view: str, photograph: Image, renders: list[Image]) -> ImageCrop:
    """Return the crop in which the renders differ most from each other, or a single render from the photo."""
    images = np.stack(renders if len(renders) > 1 else [*renders, photograph])
    difference = (images.max(axis=0) - images.min(axis=0)).mean(axis=2, dtype=np.float32)
    height, width = photograph.shape[:2]
    side = min(height, width, max(MIN_SIDE, min(MAX_SIDE, min(height, width) // 3)))
    means = cv2.boxFilter(difference, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    valid_means = means[: height - side + 1, : width - side + 1]
    y, x = np.unravel_index(int(valid_means.argmax()), valid_means.shape)
    return ImageCrop(view, photograph, renders, int(x), int(y), side, float(valid_means.max()))
