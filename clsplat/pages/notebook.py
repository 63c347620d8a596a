"""How models and scenes show themselves in a notebook."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.pages.page import embedded, render

THUMBNAIL = 160  # px, the larger side


def summary(rows: Mapping[str, str], images: Sequence[tuple[str, NDArray[np.uint8]]] = ()) -> str:
    """Return a table of names and values, and images, [height, width, 3], with their names, as a piece of HTML."""
    thumbnails = [(name, embedded(_small(image))) for name, image in images]
    return render("notebook.html.j2", rows=rows, thumbnails=thumbnails)


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    factor = THUMBNAIL / max(image.shape[:2])
    if factor >= 1:
        return image
    width, height = (max(1, round(side * factor)) for side in image.shape[1::-1])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
