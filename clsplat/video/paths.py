"""Camera paths about and through a scene, by name.

Each is a function of a rig, a number of frames and a size, and returns a view for each frame.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clsplat.errors import DataError
from clsplat.scene.view import View
from clsplat.video.lenses import Size, around, like
from clsplat.video.rig import Floats, Rig, unit
from clsplat.video.walk import order, smooth

LOG = logging.getLogger("clsplat")
WIDEST_GAP = math.radians(100)  # between neighbours on a ring about the focus: a wider one was never photographed
SHARE = 90  # percentile of the cameras' distances that an ellipse and a spiral reach (Barron et al. 2022)
FARNESS = 0.75  # of the focus of a spiral, between near (0) and far (1), by inverse depth (Mildenhall et al. 2019)
TURNS = 2  # of a spiral
SWAY = 0.3  # of its distance from what it looks at, at most: cameras that surround a scene give no front
KEPT = 0.85  # of an arc that was photographed: at its ends half of what is seen was not
MOMENT = 1e-3  # what the whole time of a scene counts beside a right angle: between the moments of one camera
AGREEMENT = 0.5  # length of the mean direction of view: below it the cameras do not face one way


def ellipse(rig: Rig, frames: int, size: Size) -> list[View]:
    """Circle the focus on an ellipse as wide as the cameras stand; where they stand on one side, swing before it.

    The half axes are the 90th percentiles of the distances along the principal axes across the upward axis, as in
    Mip-NeRF 360 (Barron et al. 2022); the height is the mean height.
    """
    across, offsets, height = _ring(rig)
    half = np.percentile(np.abs(offsets), SHARE, axis=0)
    if min(half) <= 1e-6 * max(half):
        half = np.maximum(half, 0.05 * max(half, default=0.0))
    angles = _sweep(np.arctan2(offsets[:, 1] / half[1], offsets[:, 0] / half[0]), frames)
    flat = np.stack([half[0] * np.cos(angles), half[1] * np.sin(angles)], axis=1)
    return _looking(rig, rig.focus + flat @ across + height.mean() * rig.up, rig.focus, size)


def orbit(rig: Rig, frames: int, size: Size) -> list[View]:
    """Turn once about the focus, on a circle of the cameras' median distance and height: a turntable for objects."""
    across, offsets, height = _ring(rig)
    radius = float(np.median(np.linalg.norm(offsets, axis=1)))
    taken = np.arctan2(offsets[:, 1], offsets[:, 0])
    if (unseen := _gap(taken)[0]) > WIDEST_GAP:
        LOG.warning(
            "the orbit shows %.0f degrees from where no photograph was taken; the path ellipse keeps to the others",
            math.degrees(unseen),
        )
    angles = taken[0] + 2 * np.pi * np.arange(frames) / frames
    flat = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return _looking(rig, rig.focus + flat @ across + np.median(height) * rig.up, rig.focus, size)


def spiral(rig: Rig, frames: int, size: Size) -> list[View]:
    """Sway about the mean of the cameras, two turns, and look at one point: for scenes that are faced from one side.

    Formulas of Local Light Field Fusion (Mildenhall et al. 2019).
    """
    forward, middle = rig.forwards.mean(axis=0), rig.positions.mean(axis=0)
    if np.linalg.norm(forward) < AGREEMENT:
        raise DataError("the cameras look in many directions, so that a spiral has no front; use ellipse or through")
    forward = unit(forward)
    right = unit(np.cross(forward, rig.up))
    axes = np.stack([right, np.cross(forward, right), forward])
    near, far = rig.depths
    target = middle + forward / ((1 - FARNESS) / near + FARNESS / far)
    radii = np.percentile(np.abs((rig.positions - middle) @ axes.T), SHARE, axis=0)
    radii *= min(1.0, SWAY * float(np.linalg.norm(target - middle)) / max(float(radii.max()), 1e-30))
    turn = 2 * np.pi * TURNS * np.arange(frames) / frames
    steps = np.stack([np.cos(turn), np.sin(turn), np.sin(turn / 2)], axis=1) * radii
    positions = middle + steps @ axes
    return named(
        positions, np.broadcast_to(target, positions.shape), np.broadcast_to(rig.up, positions.shape), rig, size
    )


def through(rig: Rig, frames: int, size: Size) -> list[View]:
    """Fly along the views, by name or from neighbour to neighbour, whichever way is shorter, on a smooth curve."""
    chosen = order(rig)
    distance = float(np.median(rig.depths))
    places = np.hstack([rig.positions, rig.positions + distance * rig.forwards, rig.ups])[chosen]
    track = smooth(places, frames, distance)
    return named(track[:, :3], track[:, 3:6], track[:, 6:], rig, size)


def views(rig: Rig, frames: int, size: Size) -> list[View]:
    """Show the cameras of the photographs one after the other, with their own lenses; of more than `frames` some."""
    chosen = np.unique(np.linspace(0, len(rig.views) - 1, min(frames, len(rig.views))).round().astype(int))
    return [replace(rig.views[i], camera=around(rig.views[i].camera, size), lens=None, mask_path=None) for i in chosen]


def fixed(rig: Rig, frames: int, size: Size) -> list[View]:
    """Stay at the camera in the middle of all: a film of what moves."""
    middle = np.median(rig.positions, axis=0)
    return stay(rig.views[int(np.linalg.norm(rig.positions - middle, axis=1).argmin())], frames, size)


def stay(view: View, frames: int, size: Size) -> list[View]:
    """Return a view as often as there are frames, without its photograph's moment."""
    still = replace(view, camera=around(view.camera, size), lens=None, mask_path=None, time=None)
    return [replace(still, name=f"frame_{i:05d}") for i in range(1, frames + 1)]


PATHS: dict[str, Callable[[Rig, int, Size], list[View]]] = {
    "ellipse": ellipse,
    "spiral": spiral,
    "orbit": orbit,
    "through": through,
    "views": views,
    "fixed": fixed,
}


def named(positions: Floats, targets: Floats, ups: Floats, rig: Rig, size: Size) -> list[View]:
    """Return views at positions that look at targets, [F, 3] each.  Raises DataError where one looks along its up."""
    camera = like(rig.camera, size)
    try:
        return [
            View.looking_at(position, target, up, camera, f"frame_{i:05d}")
            for i, (position, target, up) in enumerate(zip(positions, targets, ups, strict=True), 1)
        ]
    except ValueError as error:
        raise DataError(f"the cameras of the scene give no such path: {error}; use another --path") from error


def _ring(rig: Rig) -> tuple[Floats, Floats, Floats]:
    """Two axes across the upward one, [2, 3], and the cameras' offsets from the focus: along them, [V, 2], and up, [V].

    The axes are the principal ones, so that an ellipse along them fits.
    """
    offsets = rig.positions - rig.focus
    height = offsets @ rig.up
    flat = offsets - height[:, None] * rig.up
    _, vectors = np.linalg.eigh(flat.T @ flat + 1e6 * float((flat**2).sum() + 1e-30) * np.outer(rig.up, rig.up))
    first = vectors[:, 1] * (1.0 if vectors[:, 1] @ offsets[0] >= 0 else -1.0)
    across = np.stack([first, np.cross(rig.up, first)])
    return across, flat @ across.T, height


def _sweep(taken: Floats, frames: int) -> Floats:
    """Angles of the frames: around once, or to and fro where an arc was never photographed.  taken: [V]."""
    gap, begin = _gap(taken)
    turn = 2 * np.pi * np.arange(frames) / frames
    if gap < WIDEST_GAP:
        return np.asarray(taken[0] + turn)
    half = np.pi - gap / 2
    return np.asarray(begin + half + KEPT * half * np.sin(turn))


def _gap(taken: Floats) -> tuple[float, float]:
    """The widest angle without a camera, and the angle of the camera behind it."""
    ring = np.sort(taken % (2 * np.pi))
    gaps = np.diff(np.append(ring, ring[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    return float(gaps[widest]), float(ring[(widest + 1) % len(ring)])


def _looking(rig: Rig, positions: Floats, target: Floats, size: Size) -> list[View]:
    targets, ups = (np.broadcast_to(vector, positions.shape) for vector in (target, rig.up))
    return named(positions, targets, ups, rig, size)


def nearest(view: View, views: Sequence[View], reach: float) -> View:
    """Return the photograph's view whose camera is closest: `reach` of distance counts as much as a right angle.

    Of the moments of one camera it is the nearest.
    """
    apart = np.array([np.linalg.norm(view.position - other.position) for other in views]) / reach
    turned = np.array([1 - view.world_to_camera[2, :3] @ other.world_to_camera[2, :3] for other in views])
    late = np.array([abs((view.time or 0.0) - (other.time or 0.0)) for other in views])
    return views[int((apart + turned + MOMENT * late).argmin())]
