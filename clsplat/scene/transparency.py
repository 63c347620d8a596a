"""Whether photographs show a background behind them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import Scene
from clsplat.scene.view import View, load_mask, load_transparency, some_of

LOOKED_AT = 3  # training photographs: what is shown may fill one of them


def is_transparent(scene: Scene) -> bool:
    """Return whether one of some training photographs has transparent pixels that count.  Raises DataError."""
    return any(map(_is_transparent, some_of(scene.split("train"), LOOKED_AT)))


def background_shows(scene: Scene) -> bool:
    """Return whether another background can be put behind one of some training photographs.

    It cannot behind those with masks.  Raises DataError.
    """
    return any(load_transparency(view) is not None for view in some_of(scene.split("train"), LOOKED_AT))


def opaque_pixels(view: View) -> NDArray[np.bool_] | None:
    """Return which pixels of a photograph count and show no background, [H, W], or None when all do.

    Raises DataError.
    """
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    masks = [mask for mask in (None if shows is None else shows == 0, counted) if mask is not None]
    return np.logical_and.reduce(masks) if masks else None


def _is_transparent(view: View) -> bool:
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    return shows is not None and bool((shows if counted is None else shows[counted]).any())
