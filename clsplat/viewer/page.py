"""A page that shows models: one file, which needs no network and opens from a disk."""

import base64
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import OutputError
from clsplat.core.files import write_text
from clsplat.core.page import data_url, inline, render, shrink
from clsplat.core.reading import read_file
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import Packed

# Cameras as the scripts of a page read them.


def stand_data(stand: Viewpoint) -> dict[str, Any]:
    """Return where a page begins to look, as main.js reads it."""
    return {
        "pivot": rounded(stand.pivot),
        "up": rounded(stand.up),
        "radius": stand.radius,
        "focal": stand.focal,
        "start": camera_data(stand.start),
    }


def camera_data(view: View) -> dict[str, Any]:
    """Return a view's pose, by rows, and its lens as camera.js reads them."""
    c = view.camera
    moment = {} if view.time is None else {"time": view.time}
    lens = [c.fx, c.fy, c.cx, c.cy, c.width, c.height]
    return {"pose": rounded(view.world_to_camera.ravel()), "lens": lens, **moment}


def rounded(values: NDArray[np.floating]) -> list[float]:
    """Return numbers as short as single precision reads them."""
    return [float(f"{value:.9g}") for value in np.asarray(values, np.float64).tolist()]


FOLDER = Path(__file__).parent
SCRIPTS = (
    *("data", "sort", "shaders", "draw", "camera", "motion", "controls", "photographs", "frustums"),
    *("panel", "settings", "time", "main"),
)
MOMENTS = 31  # from the first to the last, where the page has no views of several
MAX_SIZE = 200.0  # MB: browsers need several times as much memory
MARGIN = 0.97  # of that size, for splats that pack worse than the average
MARK = b'<canvas id="frustums"'  # of viewer.html.j2
COLORS = {"black": [0, 0, 0], "white": [1, 1, 1]}


@dataclass(frozen=True)
class Page:
    """What a page shows: models by their names, with one camera, and the views of a scene."""

    title: str
    models: Mapping[str, Packed]
    stand: Viewpoint
    background: str = "black"
    views: Sequence[dict[str, Any]] = field(default_factory=list)

    def text(self) -> str:
        """Return the page; the same models and views give the same bytes."""
        names = [view["name"] for view in self.views]
        first = names.index(self.stand.start.name) if self.stand.start.name in names else -1
        info = {
            **stand_data(self.stand),
            "models": [{"name": name, **packed.header} for name, packed in self.models.items()],
            "views": self.views,
            "first": first,
            "background": COLORS[self.background],
            "file": re.sub(r"[^\w.-]+", "_", self.title),
            **({"moments": self._moments} if self.moves else {}),
        }
        return render(
            "viewer.html.j2",
            title=self.title,
            info=info,
            models=[base64.b64encode(packed.data).decode() for packed in self.models.values()],
            facts=self._facts(),
            background=self.background,
            style=inline(style()),
            script=inline(script()),
        )

    @property
    def moves(self) -> bool:
        """Whether a model moves."""
        return any("motion" in packed.header for packed in self.models.values())

    @property
    def _moments(self) -> list[float]:
        """Those of the views, in order."""
        moments = np.unique([view["time"] for view in self.views if "time" in view])
        return [float(moment) for moment in (moments if len(moments) > 1 else np.linspace(0, 1, MOMENTS))]

    @property
    def size(self) -> float:
        """About the size of the page, MB."""
        photographs = sum(len(view["thumbnail"]) + len(view["photograph"] or "") for view in self.views)
        return (photographs + sum(len(packed.data) * 4 / 3 for packed in self.models.values())) / 1e6 + 0.1

    @property
    def fitting(self) -> int:
        """The number of splats of each model with which a page that is too large is not."""
        splats = sum(len(packed.data) * 4 / 3 for packed in self.models.values()) / 1e6
        room = max(0.0, MAX_SIZE - (self.size - splats))
        low, high = 0, max(packed.count for packed in self.models.values())
        while low < high:  # a model with fewer splats keeps all of them
            middle = (low + high + 1) // 2
            held = sum(len(one.data) * 4 / 3 * min(1, middle / max(one.count, 1)) for one in self.models.values()) / 1e6
            low, high = (middle, high) if held <= MARGIN * room else (low, middle - 1)
        return low

    def write(self, path: Path) -> None:
        """Write the page.  Raises OutputError where it is too large for browsers, or cannot be written."""
        if self.size > MAX_SIZE:
            splats = (
                f"the {self.fitting:,} most important splats (--splats {self.fitting}), or " if self.fitting else ""
            )
            raise OutputError(
                f"{path}: the page would have {self.size:.0f} MB; browsers open {MAX_SIZE:.0f} MB at most: show "
                f"{splats}fewer photographs (--photographs, --photograph-budget)"
            )
        write_text(path, self.text())

    def _facts(self) -> dict[str, str]:
        facts = {}
        for name, packed in self.models.items():
            header, of = packed.header, f" of {name}" if len(self.models) > 1 else ""
            faint = f" + {header['faint']:,} too faint to draw" if header["faint"] else ""
            facts[f"splats{of}"] = f"{packed.count:,}{faint}, SH degree {header['degree']}"
            kept = ", keeps the energy" if header["compensate"] else ""
            blur = f"{header['variance']:g} px²{kept}"
            if "box" in header:
                blur = f"the pixel's box, drawn here as a blur of {blur}"
            facts[f"screen filter{of}"] = blur
            facts[f"size{of}"] = f"{len(packed.data) / 1e6:.2f} MB"
        return facts | ({"views": f"{len(self.views):,}"} if self.views else {})


def is_viewer(path: Path) -> bool:
    """Return whether a file is such a page.  Raises DataError where it cannot be read."""
    return MARK in read_file(path)


def script() -> str:
    """Return the scripts of the page, in one function."""
    return joined(SCRIPTS)


def joined(names: Sequence[str], others: Sequence[str] = ()) -> str:
    """Return scripts of this folder by their names, and the text of others, in one function."""
    parts = [*((FOLDER / f"{name}.js").read_text("utf-8") for name in names), *others]
    return '(() => {\n"use strict";\n' + "\n".join(parts) + "})();\n"


def style() -> str:
    """Return the style of the page."""
    return (FOLDER / "viewer.css").read_text("utf-8")


# The views of a page: cameras, thumbnails, and photographs as far as a budget of bytes goes.

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
        photograph = data_url(shrink(pixels, LARGEST)) if wanted else None
        thumbnail = data_url(shrink(pixels, THUMBNAIL))
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
