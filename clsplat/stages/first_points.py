"""Where the first Gaussians lie: at the scene's points, on surfaces that a sweep finds, or on a hull."""

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.scene.hull import hull_points
from clsplat.scene.middle import centre_of, looked_at_box
from clsplat.scene.plane_sweep import swept_points
from clsplat.scene.reprojection import require_ahead
from clsplat.scene.scene import PointCloud, Scene, View
from clsplat.scene.transparency import opaque_pixels
from clsplat.scene.view import load_image, load_rgba
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
MIN_POINTS = 100  # with fewer from a sweep or a hull, random ones are used
Chance = Callable[[NDArray[np.floating]], NDArray[np.floating]]


def own_points(scene: Scene) -> PointCloud:
    """Return the points of a scene.  Raises DataError where it has none, or all lie behind its cameras."""
    if scene.points is None:
        raise DataError(f"{scene.path}: has no points to start from; use init: {{source: sweep}}")
    require_ahead(scene.points, scene)
    return scene.points


def swept(run: Run, count: int, chance: Chance | None) -> PointCloud:
    """Return at most `count` points of a sweep over the training photographs; `chance` as of `swept_points`."""
    views = _views(run)
    return swept_points(views, centre_of(views), load_image, count, run.seed, chance)


def points_and_sweep(run: Run, count: int, chance: Chance | None) -> PointCloud:
    """Return the scene's points, and at most `count` of a sweep that are not there already.

    Transparent pixels, and those that do not count, give none.  Raises DataError where the scene has no points.
    """
    own, views = own_points(run.scene), _views(run)
    beside = own.positions.astype(np.float64)
    new = swept_points(views, centre_of(views), load_image, count, run.seed, chance, beside, opaque_pixels)
    if not len(new):
        LOG.warning("the photographs agree on no points beside the scene's; starting from these alone")
    return own.joined(new)


def enough_swept(run: Run, count: int, chance: Chance | None) -> PointCloud | None:
    """Return the points of `swept`, or None, with a warning, where they are too few."""
    points = swept(run, count, chance)
    if len(points) < MIN_POINTS:
        remedy = "photographs from places that lie closer together agree on more"
        LOG.warning("the photographs agree on %d points only; starting from random ones; %s", len(points), remedy)
        return None
    return points


def on_hull(run: Run, count: int) -> PointCloud | None:
    """Return at most `count` points on the hull of the silhouettes, or None, with a warning, where they are too few."""
    points = hull_points(_views(run), *looked_at_box(run.scene), load_rgba, count, run.seed)
    if len(points) < MIN_POINTS:
        remedy = "they need transparency around what they show, and no masks; or use init: {source: sweep}"
        LOG.warning(
            "the photographs' silhouettes give %d points only; starting from random ones; %s", len(points), remedy
        )
        return None
    return points


def _views(run: Run) -> list[View]:
    """The training views of the size that is trained on."""
    return [view for view in run.scene.split("train") if view.downscale == run.downscale]
