"""How models and scenes show themselves in a notebook."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.pages.page import embedded, render, shrunk

THUMBNAIL = 160  # px, the larger side


def summary(rows: Mapping[str, str], images: Sequence[tuple[str, NDArray[np.uint8]]] = ()) -> str:
    """Return a table of names and values, and images, [height, width, 3], with their names, as a piece of HTML."""
    thumbnails = [(name, embedded(shrunk(image, THUMBNAIL))) for name, image in images]
    return render("notebook.html.j2", rows=rows, thumbnails=thumbnails)
