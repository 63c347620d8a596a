"""An inspection as one page that opens offline: verdict, findings, figures, cameras and points."""

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from clsplat.core.files import write_text
from clsplat.core.page import render, safe_charts
from clsplat.prepare.inspect.findings import Inspection, figures
from clsplat.scene.points import MAX_VALUE
from clsplat.scene.view import View
from clsplat.scene.viewpoint import upward
from clsplat.viewer.charts import histogram

# Cameras and points in 3D: the data of a canvas that the pointer rotates.

MAX_POINTS = 5000
RADIUS = 1000  # of the scene, in the numbers of the page
MAX_COORDINATE = 30 * RADIUS  # the page leaves out points beyond
MAX_SLOPE = 5.0  # of a frustum's edges: half width by depth


KINDS = (("#63b3ed", "training"), ("#f6ad55", "test"), ("#fc5c5c", "far away from all others"))  # of cameras


def space(inspection: Inspection) -> tuple[list[tuple[str, str]], dict[str, Any]] | None:
    """Return the kinds of cameras, and these and points as space.js reads them; None when no camera could be read."""
    views = inspection.parts.views
    if not views:
        return None
    far = set(inspection.facts.strayed)
    points, colors = _points(inspection)
    near = np.stack([view.position for view in views if view.name not in far])
    origin, radius = _frame(near, points)
    axes = _axes(views) * (RADIUS / radius)
    points = (points - origin) @ axes.T
    drawn = (np.abs(points) < MAX_COORDINATE).all(axis=1)
    kinds = _kinds(inspection, far)
    size = 0.12 * float(np.median(np.linalg.norm(near - np.median(near, axis=0), axis=1))) or 0.1 * radius
    data = {
        "points": _integers(points[drawn]),
        "colors": ["".join(f"{byte:02x}" for byte in rgb) for rgb in colors[drawn].astype(int).tolist()],
        "cameras": [[kinds[view.name], *_integers((_frustum(view, size) - origin) @ axes.T)] for view in views],
        "shades": [color for color, _ in KINDS],
        "names": [view.name for view in views],
        "radius": RADIUS,
    }
    return [KINDS[index] for index in sorted(set(kinds.values()))], data


def _kinds(inspection: Inspection, far: set[str]) -> dict[str, int]:
    """The index in KINDS of each view."""
    scene = inspection.parts.scene
    test = {view.name for view in scene.split("test")} if scene else set()
    return {view.name: 2 if view.name in far else 1 if view.name in test else 0 for view in inspection.parts.views}


def _integers(coordinates: NDArray[np.floating]) -> list[int]:
    return list(np.rint(np.clip(coordinates, -(2**53), 2**53)).astype(int).ravel().tolist())


def _points(inspection: Inspection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions and colors of at most MAX_POINTS points, evenly spaced in the file."""
    table = inspection.parts.points
    if table is None or not len(table.positions):
        return np.empty((0, 3)), np.empty((0, 3))
    finite = np.flatnonzero((np.abs(table.positions) < MAX_VALUE).all(axis=1))
    chosen = finite[:: max(1, -(-len(finite) // MAX_POINTS))]
    return table.positions[chosen].astype(np.float64), table.rgb[chosen].astype(np.float64)


def _frame(centers: NDArray[np.floating], points: NDArray[np.float64]) -> tuple[NDArray[np.floating], float]:
    """The middle of what is drawn, [3], and its radius: all cameras, and most points unless they are far away."""
    middle = np.median(centers, axis=0)
    reach = float(np.linalg.norm(centers - middle, axis=1).max()) or 1.0
    close = points[np.linalg.norm(points - middle, axis=1) < 5 * reach]
    if len(close):
        middle = (middle + np.median(close, axis=0)) / 2
    distances = np.linalg.norm(centers - middle, axis=1).max()
    if len(close):
        distances = max(distances, np.quantile(np.linalg.norm(close - middle, axis=1), 0.7))
    return middle, float(distances) or 1.0


def _axes(views: list[View]) -> NDArray[np.float64]:
    """Rows: right, forward and up of the canvas in world coordinates, from the cameras' mean orientation.

    Forward is where most cameras look, so that the first view is from behind them; without such a side it is arbitrary.
    """
    up = upward(views)
    forward = np.mean([view.world_to_camera[2, :3] for view in views], axis=0)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 0.2:
        right = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _frustum(view: View, size: float) -> NDArray[np.float64]:
    """Center and corners of the image at a depth of `size`, [5, 3], in world coordinates."""
    camera = view.camera
    corners = [(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)]
    rays = [((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0) for x, y in corners]
    local = np.clip([(0.0, 0.0, 0.0), *rays], -MAX_SLOPE, MAX_SLOPE) * size
    rotation = view.world_to_camera[:, :3]
    return np.asarray(view.position + local @ rotation)


MAX_NAMES = 200  # of a list
MAX_VIEWS = 8  # in the table of those that see the fewest points


def write_page(inspection: Inspection, out: Path) -> None:
    """Write the page.  Raises OutputError when that fails."""
    write_text(out, inspection_page(inspection))


def inspection_page(inspection: Inspection) -> str:
    """Return the page."""
    path = inspection.facts.path
    name = path.rstrip("/").rpartition("/")[2] or path
    worst = inspection.findings[0].level if inspection.findings else "note"
    return render(
        "inspect.html.j2",
        title=f"{name}: inspection of the dataset",
        subtitle=path,
        state="ready" if worst == "note" else worst,
        verdict=inspection.verdict[0].upper() + inspection.verdict[1:],
        findings=inspection.findings,
        figures=figures(inspection.facts),
        space=space(inspection),
        seen=_seen(inspection),
        lists=_lists(inspection),
    )


def _seen(inspection: Inspection) -> tuple[list[Markup], list[tuple[str, int]]] | None:
    """A histogram, and the views that see the fewest points; None where the dataset has no such counts."""
    seen = inspection.facts.seen
    if not seen:
        return None
    fewest = sorted(seen.items(), key=lambda item: item[1])[:MAX_VIEWS]
    return safe_charts([histogram("views by their number of points", list(seen.values()))]), fewest


def _lists(inspection: Inspection) -> list[tuple[str, list[str], int]]:
    """The names behind figures: a title, MAX_NAMES of them, and their number."""
    facts, photographs = inspection.facts, inspection.facts.photos
    lists = {
        "registered but missing on disk": facts.missing,
        "on disk but without a pose": facts.unregistered,
        "cannot be read": [f"{name}: {reason}" for name, reason in photographs.unreadable.items()],
        "not of the camera's size": [f"{name}: {size}" for name, size in photographs.misfits.items()],
        "end of the file is missing": photographs.cut,
        "rotated by the EXIF data": photographs.exif_turned,
        "far away from all others": facts.strayed,
        "same pose": [" = ".join(names) for names in facts.same_pose],
        "few points": facts.few_seen,
    }
    return [(title, names[:MAX_NAMES], len(names)) for title, names in lists.items() if names]
