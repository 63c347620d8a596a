"""Cameras and points in 3D: a canvas that turns under the pointer, all data inside the page."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.inspect.inspection import Inspection
from clsplat.scene.points import FAR
from clsplat.scene.scene import View

SHOWN = 5000  # points
UNIT = 1000  # the picture's radius in the numbers of the page
WIDEST = 5.0  # half width of a frustum by its depth
REACH = 30 * UNIT  # points beyond are left out
SCRIPT = (Path(__file__).parent / "space.js").read_text(encoding="utf-8")
STYLE = """
.space{position:relative}.space canvas{width:100%;height:560px;display:block;background:#141a24;border-radius:6px;
cursor:grab;touch-action:none}.space canvas:active{cursor:grabbing}
.space nav{position:absolute;top:.7rem;right:.7rem;display:flex;gap:.3rem}
.space button{font:12px system-ui;border:0;border-radius:4px;padding:.25rem .6rem;background:#2d3748;color:#edf2f7;
cursor:pointer}.space button:hover{background:#4a5568}
.space output{position:absolute;left:.8rem;bottom:.6rem;color:#edf2f7;font-size:.82rem;pointer-events:none}
.legend i{display:inline-block;width:.7rem;height:.7rem;border-radius:2px;margin:0 .3rem 0 1rem}
"""
KINDS = (("#63b3ed", "training"), ("#f6ad55", "test"), ("#fc5c5c", "far away from all others"))  # cameras


def space(inspection: Inspection) -> str:
    """Return the canvas and its data as HTML; "" when no camera could be read."""
    views = inspection.parts.views
    if not views:
        return ""
    away = set(inspection.facts.strayed)
    points, colours = _points(inspection)
    near = np.stack([view.position for view in views if view.name not in away])
    origin, radius = _frame(near, points)
    axes = _axes(views) * (UNIT / radius)
    points = (points - origin) @ axes.T
    shown = (np.abs(points) < REACH).all(axis=1)
    test = {view.name for view in inspection.parts.scene.split("test")} if inspection.parts.scene else set()
    kinds = {view.name: 2 if view.name in away else 1 if view.name in test else 0 for view in views}
    size = 0.12 * float(np.median(np.linalg.norm(near - np.median(near, axis=0), axis=1))) or 0.1 * radius
    data = {
        "points": _whole(points[shown]),
        "colours": ["".join(f"{byte:02x}" for byte in rgb) for rgb in colours[shown].astype(int).tolist()],
        "cameras": [[kinds[view.name], *_whole((_frustum(view, size) - origin) @ axes.T)] for view in views],
        "shades": [shade for shade, _ in KINDS],
        "names": [view.name for view in views],
    }
    shades = "".join(f'<i style="background:{KINDS[k][0]}"></i>{KINDS[k][1]}' for k in sorted(set(kinds.values())))
    legend = f'<p class="sub legend">Drag to turn, scroll to zoom, point at a camera for its name.{shades}</p>'
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    buttons = "".join(f"<button data-view={name}>{name}</button>" for name in ("oblique", "top", "side"))
    return (
        f'<h2>Cameras and points</h2>{legend}<div class=space><canvas aria-label="cameras and points"></canvas>'
        f"<nav>{buttons}</nav><output></output><script type=application/json>{text}</script></div>"
    )


def _whole(coordinates: NDArray[np.floating]) -> list[int]:
    return list(np.rint(np.clip(coordinates, -(2**53), 2**53)).astype(int).ravel().tolist())


def _points(inspection: Inspection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions and colours of at most SHOWN points, evenly spaced in the file."""
    table = inspection.parts.points
    if table is None or not len(table.positions):
        return np.empty((0, 3)), np.empty((0, 3))
    finite = np.flatnonzero((np.abs(table.positions) < FAR).all(axis=1))
    chosen = finite[:: max(1, -(-len(finite) // SHOWN))]
    return table.positions[chosen].astype(np.float64), table.rgb[chosen].astype(np.float64)


def _frame(centres: NDArray[np.floating], points: NDArray[np.float64]) -> tuple[NDArray[np.floating], float]:
    """The middle of the picture, [3], and how far it reaches: all cameras, and most points unless they are far."""
    middle = np.median(centres, axis=0)
    reach = float(np.linalg.norm(centres - middle, axis=1).max()) or 1.0
    close = points[np.linalg.norm(points - middle, axis=1) < 5 * reach]
    if len(close):
        middle = (middle + np.median(close, axis=0)) / 2
    distances = np.linalg.norm(centres - middle, axis=1).max()
    if len(close):
        distances = max(distances, np.quantile(np.linalg.norm(close - middle, axis=1), 0.7))
    return middle, float(distances) or 1.0


def _axes(views: list[View]) -> NDArray[np.float64]:
    """Rows: right, forward and up of the picture in world coordinates, from the cameras' mean orientation.

    Forward is where most cameras look, so that the picture opens from behind them; without such a side it is arbitrary.
    """
    up = -np.mean([view.world_to_camera[1, :3] for view in views], axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0.0, 0.0, 1.0])
    forward = np.mean([view.world_to_camera[2, :3] for view in views], axis=0)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 0.2:
        right = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _frustum(view: View, size: float) -> NDArray[np.float64]:
    """Centre and corners of the image at a depth of `size`, [5, 3], in world coordinates."""
    camera = view.camera
    corners = [(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)]
    rays = [((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0) for x, y in corners]
    local = np.clip([(0.0, 0.0, 0.0), *rays], -WIDEST, WIDEST) * size
    rotation = view.world_to_camera[:, :3]
    return np.asarray(view.position + local @ rotation)
