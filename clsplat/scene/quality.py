"""What is measured of a capture before training, for settings that follow from it."""

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

NEAREST = 0.01  # share of the points that photographs show which may lie nearer: some of them are mistaken


@dataclass
class Measures:
    """What is known of photographs before training."""

    photographs: int
    """Number of training photographs; those for validation count."""
    reprojection_error: float | None = None
    """Mean distance between a point and where photographs show it, px at the size of training; None: not known."""
    scene: Scene | None = None
    """The scene as it is trained on; None: not prepared yet."""
    measure_sky: Callable[[], float | None] = lambda: None

    @cached_property
    def sky(self) -> float | None:
        """The share of the training photographs that show a sky, for which all are read; None: not known."""
        return self.measure_sky()


def measure_scene(scene: Scene, measure_sky: Callable[[], float | None] = lambda: None) -> Measures:
    """Return the measures of a scene, as it is trained on."""
    views = {view.name: view for view in reversed(scene.merge_validation().split("train"))}  # the largest size of each
    errors = reprojection_errors(scene.tracks, views.values())
    return Measures(len(views), None if errors is None else float(errors.mean()), scene, measure_sky)


def near_depth(scene: Scene) -> float | None:
    """Return the depth, scene units, that a hundredth of all points that training views show are nearer than.

    Views for validation count as training views.  None where the dataset does not tell which points views show.
    """
    if scene.tracks is None:
        return None
    shown = [
        (view, scene.tracks.positions[scene.tracks.seen.get(view.name, [])])
        for view in scene.merge_validation().split("train")
    ]
    with np.errstate(all="ignore"):  # points of a damaged file
        depths = [points @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3] for view, points in shown]
    ahead = [one[(one > 0) & (one < np.inf)] for one in depths]
    return float(np.quantile(np.concatenate(ahead), NEAREST)) if any(map(len, ahead)) else None


# How sharp a photograph is, by its small details.

BLURRED = 0.25  # share of the middle of a set: six captures have 0.4 and more, a blur of 1 px leaves 0.05 to 0.09
SIDE = 480  # px: sharpness is measured at this size: at full size, noise counts as detail


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an image [H, W], gray levels²."""
    return float(cv2.Laplacian(gray, cv2.CV_64F).var())


def both_sharpnesses(gray: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the sharpness of an image [H, W], and it by the square of its mean, which a darker copy has too, [2]."""
    found = sharpness(gray)
    return np.array([found, found / max(float(gray.mean()), 1.0) ** 2])


def sharpness_of(path: Path) -> NDArray[np.float64]:
    """Return both sharpnesses of a photograph, reduced to SIDE px.  Raises DataError when it cannot be read."""
    return both_sharpnesses(read_gray(path, SIDE)[0])


def is_blurred(own: NDArray[np.float64], middle: NDArray[np.float64]) -> bool:
    """Return whether both sharpnesses of a photograph are far below the medians of a set, [2].

    The first alone is small of a dark photograph, the second of a bright one among dark ones.
    """
    return bool((own < BLURRED * middle).all())


# How much detail photographs show at each pixel: there Gaussians are to lie densely.

Floats = NDArray[np.floating]
MAX_SPACING = 0.1  # by the width of the photograph (Meuleman et al. 2025)


def laplacian_probability(image: Floats) -> Floats:
    """Return the chance, [H, W], with which a pixel of a photograph, [H, W, 3] in [0, 1], becomes a point.

    It is min(1, ‖∇²I‖₁) with the Laplacian of five points, summed over the colors (Meuleman et al. 2025).  There it is
    averaged over a disc of weight 1; here photographs are so small that each pixel is an average already, and the
    factor stays 1.  A pixel that differs from the mean of its neighbors by a twelfth of the range in each color has
    the chance 1.
    """
    framed = np.pad(image.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    middle, around = framed[1:-1, 1:-1], (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
    chance: Floats = np.minimum(np.abs(sum(around) - 4 * middle).sum(axis=2), 1)
    return chance


def point_spacing(chance: Floats, width: int) -> Floats:
    """Return the distance in pixels between points that are taken with some chances above 0: 1/√chance.

    It is at most MAX_SPACING by the width of the photograph, px.
    """
    distance: Floats = np.minimum(1 / np.sqrt(chance), MAX_SPACING * width)
    return distance


# Whether photographs show a background behind them.

LOOKED_AT = 3  # training photographs: what is shown may fill one of them


def is_transparent(scene: Scene) -> bool:
    """Return whether one of some training photographs has transparent pixels that count.  Raises DataError."""
    return any(map(_is_transparent, sample_views(scene.split("train"), LOOKED_AT)))


def background_shows(scene: Scene) -> bool:
    """Return whether another background can be put behind one of some training photographs.

    It cannot behind those with masks.  Raises DataError.
    """
    return any(load_transparency(view) is not None for view in sample_views(scene.split("train"), LOOKED_AT))


def opaque_pixels(view: View) -> NDArray[np.bool_] | None:
    """Return which pixels of a photograph count and show no background, [H, W], or None when all do.

    Raises DataError.
    """
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    masks = [mask for mask in (None if shows is None else shows == 0, counted) if mask is not None]
    return np.logical_and.reduce(masks) if masks else None


def _is_transparent(view: View) -> bool:
    shows, counted = load_transparency(replace(view, mask_path=None)), load_mask(view)
    return shows is not None and bool((shows if counted is None else shows[counted]).any())
