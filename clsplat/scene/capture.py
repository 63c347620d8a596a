"""What is measured of a capture before training, for the choices that follow from it."""

from collections.abc import Container
from typing import Literal

import numpy as np

from clsplat.errors import amount
from clsplat.scene.reprojection import reprojection_errors
from clsplat.scene.scene import Scene

Measure = Literal["photographs", "photographs_per_point", "pixels", "points", "reprojection_error", "sky"]
Measures = dict[Measure, float]
NEAREST = 0.01  # share of the points that photographs show which may lie nearer: some of them are mistaken
TOLD: dict[Measure, str] = {
    "photographs_per_point": "{:,.4g} training photographs show a point, in the mean",
    "pixels": "{:,.4g} pixels has a training photograph, in the median",
    "points": "{:,.4g} points",
    "reprojection_error": "{:,.4g} px are between a point and where photographs show it, in the mean at the size of "
    "training",
    "sky": "{:.0%} of the training photographs show a sky",
}


def told(measure: Measure, value: float) -> str:
    """Return a measure in words."""
    return amount(round(value), "training photograph") if measure == "photographs" else TOLD[measure].format(value)


def measured(scene: Scene) -> Measures:
    """Return the measures that a scene, as it is trained on, has; views for validation count as training views.

    `sky` is not among them: it needs the photographs.
    """
    views = {view.name: view for view in reversed(scene.with_fold().split("train"))}  # the largest size of each
    errors = reprojection_errors(scene.tracks, views.values())
    found: dict[Measure, float | None] = {
        "photographs": len(views),
        "photographs_per_point": _photographs_per_point(scene, views),
        "pixels": float(np.median([view.camera.width * view.camera.height for view in views.values()])),
        "points": len(scene.points) if scene.points else None,
        "reprojection_error": None if errors is None else float(errors.mean()),
    }
    return {measure: value for measure, value in found.items() if value is not None}


def nearest_points(scene: Scene) -> float | None:
    """Return the depth, scene units, that a hundredth of all points that training views show are nearer than.

    Views for validation count as training views.  None where the dataset does not tell which points views show.
    """
    if scene.tracks is None:
        return None
    shown = [
        (view, scene.tracks.positions[scene.tracks.seen.get(view.name, [])])
        for view in scene.with_fold().split("train")
    ]
    with np.errstate(all="ignore"):  # points of a damaged file
        depths = [points @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3] for view, points in shown]
    ahead = [one[(one > 0) & (one < np.inf)] for one in depths]
    return float(np.quantile(np.concatenate(ahead), NEAREST)) if any(map(len, ahead)) else None


def _photographs_per_point(scene: Scene, names: Container[str]) -> float | None:
    if scene.tracks is None:
        return None
    rows = [scene.tracks.seen[name] for name in scene.tracks.seen if name in names]
    counts = np.bincount(np.concatenate(rows)) if rows else np.zeros(0)
    return float(counts[counts > 0].mean()) if counts.any() else None
