"""The views of a page: cameras, thumbnails, and photographs as far as a budget of bytes goes."""

from collections.abc import Callable, Iterable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.pages.page import embedded, shrunk
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.viewer.cameras import camera_data

Which = Literal["none", "test", "all"]  # views whose photographs are in the page
THUMBNAIL, LARGEST = 128, 1000  # px, the longer side
BUDGET = 4.0  # MB of photographs
Image = NDArray[np.uint8]


def described(
    scene: Scene,
    read: Callable[[View], Image],
    which: Which,
    budget: float = BUDGET,
    through: Callable[[Iterable[View]], Iterable[View]] = lambda views: views,
) -> list[dict[str, Any]]:
    """Return every view of a scene as photographs.js reads it.

    read: returns a photograph, RGB at the camera's size; budget: MB of photographs, of which every second, third, …
    is left out until the others fit; through: what the views pass, such as a display of progress.
    """
    test = {view.name for view in scene.split("test")}
    views: list[dict[str, Any]] = []
    for view in through(scene.views):
        pixels, split = read(view), "test" if view.name in test else "train"
        wanted = which == "all" or which == split
        photograph = embedded(shrunk(pixels, LARGEST)) if wanted else None
        thumbnail = embedded(shrunk(pixels, THUMBNAIL))
        views.append(
            {"name": view.name, "split": split, "thumbnail": thumbnail, "photograph": photograph, **camera_data(view)}
        )
    held = [view for view in views if view["photograph"]]
    for i in left_out([len(view["photograph"]) for view in held], round(1e6 * budget)):
        held[i]["photograph"] = None
    return views


def left_out(sizes: list[int], budget: int) -> set[int]:
    """Return the indices to leave out, so that every n-th stays and their sum is at most `budget`."""
    every = next((n for n in range(1, len(sizes) + 1) if sum(sizes[::n]) <= budget), len(sizes) + 1)
    kept = set(range(0, len(sizes), every)) if every <= len(sizes) else set()
    return set(range(len(sizes))) - kept
