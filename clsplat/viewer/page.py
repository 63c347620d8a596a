"""Write the viewer page: a single HTML file that shows models and works offline."""

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
from clsplat.core.page import data_url, downscale, inline, render
from clsplat.core.reading import read_file
from clsplat.scene.scene import Scene, format_position
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import PackedModel


def viewpoint_data(viewpoint: Viewpoint) -> dict[str, Any]:
    """Return the initial viewpoint of a page in the format of main.js."""
    return {
        "pivot": round_to_float32(viewpoint.pivot),
        "up": round_to_float32(viewpoint.up),
        "radius": viewpoint.radius,
        "focal": viewpoint.focal,
        "start": camera_data(viewpoint.start),
    }


def camera_data(view: View) -> dict[str, Any]:
    """Return the row-major pose, the intrinsics, and the timestamp, if any, of a view in the format of camera.js."""
    c = view.camera
    time = {} if view.time is None else {"time": view.time}
    lens = [c.fx, c.fy, c.cx, c.cy, c.width, c.height]
    return {"pose": round_to_float32(view.world_to_camera.ravel()), "lens": lens, **time}


def round_to_float32(values: NDArray[np.floating]) -> list[float]:
    """Round values to nine significant digits, which identify a float32 exactly."""
    return [float(f"{value:.9g}") for value in np.asarray(values, np.float64).tolist()]


FOLDER = Path(__file__).parent
SCRIPTS = (
    *("data", "sort", "shaders", "draw", "camera", "motion", "controls", "photographs", "frustums"),
    *("panel", "settings", "time", "main"),
)
TIMESTAMPS = 31  # number of timestamps if the views of the page have fewer than two
MAX_SIZE = 200.0  # MB; browsers need several times this in memory
MARGIN = 0.97  # fraction of MAX_SIZE to fill, because important splats may compress worse than the average
MARK = b'<canvas id="frustums"'  # in viewer.html.j2; identifies viewer pages
COLORS = {"black": [0, 0, 0], "white": [1, 1, 1]}


@dataclass(frozen=True)
class Page:
    """The contents of a page: models by name, the initial viewpoint, and the views of a scene."""

    title: str
    models: Mapping[str, PackedModel]
    viewpoint: Viewpoint
    background: str = "black"
    views: Sequence[dict[str, Any]] = field(default_factory=list)
    origin: NDArray[np.floating] = field(default_factory=lambda: np.zeros(3))  # [3] world coordinates

    def text(self) -> str:
        """Return the HTML of the page; the same models and views give the same bytes."""
        names = [view["name"] for view in self.views]
        first_view = names.index(self.viewpoint.start.name) if self.viewpoint.start.name in names else -1
        info = {
            **viewpoint_data(self.viewpoint),
            "models": [{"name": name, **packed.header} for name, packed in self.models.items()],
            "views": self.views,
            "first": first_view,
            "background": COLORS[self.background],
            "file": re.sub(r"[^\w.-]+", "_", self.title),
            **({"timestamps": self._timestamps} if self.is_moving else {}),
        }
        return render(
            "viewer.html.j2",
            title=self.title,
            info=info,
            models=[base64.b64encode(packed.data).decode() for packed in self.models.values()],
            facts=self._facts(),
            background=self.background,
            style=inline(read_style()),
            script=inline(read_script()),
        )

    @property
    def is_moving(self) -> bool:
        """Whether any model has motion."""
        return any("motion" in packed.header for packed in self.models.values())

    @property
    def _timestamps(self) -> list[float]:
        """The timestamps of the views, in order, or evenly spaced timestamps if there are fewer than two."""
        times = np.unique([view["time"] for view in self.views if "time" in view])
        return [float(time) for time in (times if len(times) > 1 else np.linspace(0, 1, TIMESTAMPS))]

    @property
    def size(self) -> float:
        """The approximate size of the page, MB."""
        photograph_bytes = sum(len(view["thumbnail"]) + len(view["photograph"] or "") for view in self.views)
        return (photograph_bytes + sum(len(packed.data) * 4 / 3 for packed in self.models.values())) / 1e6 + 0.1

    @property
    def max_splats(self) -> int:
        """The largest number of splats per model that keeps the page below MAX_SIZE."""
        splat_size = sum(len(packed.data) * 4 / 3e6 for packed in self.models.values())
        available_size = max(0.0, MAX_SIZE - (self.size - splat_size))
        low, high = 0, max(packed.count for packed in self.models.values())
        while low < high:  # a model with fewer splats keeps all of them
            count = (low + high + 1) // 2
            size = sum(len(p.data) * 4 / 3e6 * min(1, count / max(p.count, 1)) for p in self.models.values())
            low, high = (count, high) if size <= MARGIN * available_size else (low, count - 1)
        return low

    def write(self, path: Path) -> None:
        """Write the page.  Raises OutputError if the page is too large for browsers or cannot be written."""
        if self.size > MAX_SIZE:
            limit = self.max_splats
            remedy = f"only the {limit:,} most important splats (--splats {limit}), or " if limit else ""
            raise OutputError(
                f"{path}: the page would be {self.size:.0f} MB, and browsers open at most {MAX_SIZE:.0f} MB; show "
                f"{remedy}fewer photos (--photographs, --photograph-budget)"
            )
        write_text(path, self.text())

    def _facts(self) -> dict[str, str]:
        facts = {}
        for name, packed in self.models.items():
            header, suffix = packed.header, f" of {name}" if len(self.models) > 1 else ""
            facts[f"splats{suffix}"] = f"{packed.count_text}, SH degree {header['degree']}"
            blur = f"{header['variance']:g} px²{', normalized' if header['compensate'] else ''}"
            facts[f"screen filter{suffix}"] = f"pixel box, drawn here as a blur of {blur}" if "box" in header else blur
            facts[f"size{suffix}"] = f"{len(packed.data) / 1e6:.2f} MB"
        facts |= {"views": f"{len(self.views):,}"} if self.views else {}
        return facts | ({"origin": format_position(self.origin)} if self.origin.any() else {})


def is_viewer(path: Path) -> bool:
    """Return whether a file is a viewer page.  Raises DataError if it cannot be read."""
    return MARK in read_file(path)


def read_script() -> str:
    """Read the scripts of the page and join them into one JavaScript function."""
    return join_scripts(SCRIPTS)


def join_scripts(names: Sequence[str], sources: Sequence[str] = ()) -> str:
    """Join named scripts of this folder and the sources of other scripts into one JavaScript function."""
    parts = [*((FOLDER / f"{name}.js").read_text("utf-8") for name in names), *sources]
    return '(() => {\n"use strict";\n' + "\n".join(parts) + "})();\n"


def read_style() -> str:
    """Read the style sheet of the page."""
    return (FOLDER / "viewer.css").read_text("utf-8")


# The views of a page: cameras, thumbnails, and photos within a budget of bytes.

IncludedPhotos = Literal["none", "test", "all"]  # views whose photos are in the page
THUMBNAIL_SIDE, PHOTO_SIDE = 128, 1000  # px, the longer side
BUDGET = 4.0  # MB of photos
Image = NDArray[np.uint8]


def view_entries(
    scene: Scene,
    read: Callable[[View], Image],
    included: IncludedPhotos,
    budget: float = BUDGET,
    progress: Callable[[Iterable[View]], Iterable[View]] = lambda views: views,
) -> list[dict[str, Any]]:
    """Return the data of every view of a scene in the format of photographs.js.

    read: returns a photo, RGB at the camera's size.  budget: maximum size of all photos, MB; if they are larger, only
    every n-th photo is included.  progress: wraps the iteration over views, for example in a progress bar.
    """
    test_names = {view.name for view in scene.split("test")}
    views: list[dict[str, Any]] = []
    for view in progress(scene.views):
        pixels, split = read(view), "test" if view.name in test_names else "train"
        is_included = included in ("all", split)
        photograph = data_url(downscale(pixels, PHOTO_SIDE)) if is_included else None
        thumbnail = data_url(downscale(pixels, THUMBNAIL_SIDE))
        views.append(
            {"name": view.name, "split": split, "thumbnail": thumbnail, "photograph": photograph, **camera_data(view)}
        )
    views_with_photo = [view for view in views if view["photograph"]]
    for i in omitted_indices([len(view["photograph"]) for view in views_with_photo], round(1e6 * budget)):
        views_with_photo[i]["photograph"] = None
    return views


def omitted_indices(sizes: list[int], budget: int) -> set[int]:
    """Return the indices to omit.  Every n-th item is kept, with the smallest n for which the total fits `budget`."""
    interval = next((n for n in range(1, len(sizes) + 1) if sum(sizes[::n]) <= budget), len(sizes) + 1)
    return {i for i in range(len(sizes)) if interval > len(sizes) or i % interval}
