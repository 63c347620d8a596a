"""The page of a live preview, with the style and the controls of the viewer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clsplat.pages.page import inline, render
from clsplat.scene.stand import Stand
from clsplat.scene.view import View
from clsplat.viewer.cameras import camera_data, stand_data
from clsplat.viewer.page import joined, style

FOLDER = Path(__file__).parent
SHARED = ("camera", "motion", "controls", "photographs", "frustums", "panel")  # of the viewer
OWN = ("curves", "link", "live")


def page() -> bytes:
    """Return the page, which asks for all else."""
    own = [(FOLDER / f"{name}.js").read_text("utf-8") for name in OWN]
    text = render(
        "live.html.j2",
        style=inline(style() + (FOLDER / "live.css").read_text("utf-8")),
        script=inline(joined(SHARED, own)),
    )
    return text.encode()


def scene_data(number: int, title: str, views: Sequence[View], test: set[str], stand: Stand) -> dict[str, Any]:
    """Return what live.js reads of a run: its views and the frame of motion."""

    def described(index: int, view: View) -> dict[str, Any]:
        of = f"view={index}&scene={number}"
        pictures = {kind: f"{kind}.jpg?{of}" for kind in ("thumbnail", "photograph")}
        split = "test" if view.name in test else "train"
        return {"name": view.name, "split": split, **pictures, **camera_data(view)}

    first = next((i for i, view in enumerate(views) if view is stand.start), -1)
    described_views = [described(i, view) for i, view in enumerate(views)]
    return {"number": number, "title": title, **stand_data(stand), "views": described_views, "first": first}
