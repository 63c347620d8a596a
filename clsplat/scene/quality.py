"""Measure photographs before training, to adapt settings to them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.images import read_gray
from clsplat.scene.reprojection import reprojection_errors
from clsplat.scene.scene import Scene
from clsplat.scene.view import View, load_mask, load_transparency, sample_views

NEAREST = 0.01  # quantile of the depths of observed points: a few nearer ones are wrong


@dataclass
class Measures:
    """Measurements of the photographs before training."""

    photographs: int
    """Number of training photographs, including those for validation."""
    reprojection_error: float | None = None
    """Mean reprojection error of the points, px at the size of training; None: unknown."""
    scene: Scene | None = None
    """The scene at the size of training; None: not prepared yet."""
    measure_sky: Callable[[], float | None] = lambda: None

    @cached_property
    def sky(self) -> float | None:
        """The fraction of the training photographs that show a sky, which reads all of them; None: unknown."""
        return self.measure_sky()


def measure_scene(scene: Scene, measure_sky: Callable[[], float | None] = lambda: None) -> Measures:
    """Return the measurements of a scene at the size of training."""
    views = {view.name: view for view in reversed(scene.merge_validation().split("train"))}  # the largest size of each
    errors = reprojection_errors(scene.tracks, views.values())
    return Measures(len(views), None if errors is None else float(errors.mean()), scene, measure_sky)


def near_depth(scene: Scene) -> float | None:
    """Return the depth in scene units below which 1 % of all observed points are, over the training views.

    Validation views count as training views.  None when the dataset does not say which views observe which points.
    """
    if scene.tracks is None:
        return None
    shown = [
        (view, scene.tracks.positions[scene.tracks.seen.get(view.name, [])])
        for view in scene.merge_validation().split("train")
    ]
    with np.errstate(all="ignore"):  # points of a damaged file
        depths = [points @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3] for view, points in shown]
    ahead = [depth[(depth > 0) & (depth < np.inf)] for depth in depths]
    return float(np.quantile(np.concatenate(ahead), NEAREST)) if any(map(len, ahead)) else None


# Sharpness of photographs.

BLURRED = 0.25  # of the median of a set: six captures have at least 0.4, a blur of 1 px leaves 0.05 to 0.09
SIDE = 480  # px: sharpness is measured at this size, since noise looks like detail at full size


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an image [H, W], gray levels²."""
    return float(cv2.Laplacian(gray, cv2.CV_64F).var())


def both_sharpnesses(gray: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the sharpness of an image [H, W] and, invariant to brightness, divided by its squared mean, [2]."""
    value = sharpness(gray)
    return np.array([value, value / max(float(gray.mean()), 1.0) ** 2])


def sharpness_of(path: Path) -> NDArray[np.float64]:
    """Return both sharpness values of a photograph, reduced to SIDE px.  Raises DataError when it cannot be read."""
    return both_sharpnesses(read_gray(path, SIDE)[0])


def is_blurred(values: NDArray[np.float64], median: NDArray[np.float64]) -> bool:
    """Return whether both sharpness values of a photograph are far below the medians of a set, [2].

    The first one is also small for a dark photograph, the second one for a bright photograph among dark ones.
    """
    return bool((values < BLURRED * median).all())


# Transparency of photographs.

LOOKED_AT = 3  # training photographs, since the object may fill one of them


def is_transparent(scene: Scene) -> bool:
    """Return whether a sampled training photograph has transparent pixels that are not masked.  Raises DataError."""
    return any(map(_is_transparent, sample_views(scene.split("train"), LOOKED_AT)))


def background_shows(scene: Scene) -> bool:
    """Return whether a sampled training photograph can be composited on another background.

    Photographs with masks cannot.  Raises DataError.
    """
    return any(load_transparency(view) is not None for view in sample_views(scene.split("train"), LOOKED_AT))


def opaque_pixels(view: View) -> NDArray[np.bool_] | None:
    """Return which pixels of a photograph are opaque and not masked, [H, W], or None when all are.

    Raises DataError.
    """
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    masks = [mask for mask in (None if shows is None else shows == 0, counted) if mask is not None]
    return np.logical_and.reduce(masks) if masks else None


def _is_transparent(view: View) -> bool:
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    return shows is not None and bool((shows if counted is None else shows[counted]).any())
