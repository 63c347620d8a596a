"""The cameras of a run from above, beside the points of its scene."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from clsplat.pages.page import charts
from clsplat.pages.plan import Marks, plan
from clsplat.scene.scene import SPLITS
from clsplat.scene.stand import across, upward
from clsplat.scene.view import View
from clsplat.training.run import Run

MOST_POINTS = 1500
FAR = 3.0  # points farther than this, in halves of the cameras' extent around their middle, are left out


def cameras(run: Run) -> list[Markup]:
    """Draw training and test cameras from above, and Gaussians between them."""
    scene = run.original
    if len(scene.views) < 2:
        return []
    right, ahead = _axes(scene.views)

    def flat(points: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.stack([points @ right, points @ ahead], axis=-1)

    marks = []
    for split in SPLITS:
        views = scene.split(split)
        if views:
            directions = np.stack([view.world_to_camera[2, :3] for view in views])
            marks.append(Marks(split, flat(np.stack([view.position for view in views])), flat(directions)))
    centres = np.concatenate([one.centres for one in marks])
    middle, reach = centres.mean(axis=0), FAR * float(np.abs(centres - centres.mean(axis=0)).max())
    means = run.model.gaussians.get("means") if run.gaussians else np.zeros((0, 3), np.float32)
    points = flat(means[:: max(1, len(means) // MOST_POINTS)].astype(np.float64))
    near = points[(np.abs(points - middle) < max(reach, 1e-9)).all(axis=1)]
    return charts([plan("cameras from above", marks, near)])


def _axes(views: Sequence[View]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two directions across what is up for the cameras, each [3]."""
    up = upward(views)
    right = across(up)
    return right, np.cross(right, up)
