"""Measure the photographs before training, so that settings can be adapted to them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.scene.images import read_gray
from clsplat.scene.reprojection import reprojection_errors
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import MIN_WHITE, View, load_mask, load_transparency, sample_views

NEAR_QUANTILE = 0.01  # quantile of the depths of observed points; the nearest few points are usually wrong
NEAR_FRACTION = 0.04  # near plane, as a fraction of the extent
MAX_POINTS = 10_000  # points of a cloud that are used to estimate depths


@dataclass
class Measures:
    """Measurements of the photographs before training."""

    photograph_count: int
    """Number of training photos, including those for validation."""
    reprojection_error: float | None = None
    """Mean reprojection error of the points, px at the training resolution; None: unknown."""
    scene: Scene | None = None
    """The scene at the training resolution; None: not prepared yet."""


def measure_scene(scene: Scene) -> Measures:
    """Return the measurements of a scene at the training resolution."""
    views = {view.name: view for view in reversed(scene.merge_validation().split("train"))}  # the largest size of each
    errors = reprojection_errors(scene.tracks, views.values())
    return Measures(len(views), None if errors is None else float(errors.mean()), scene)


def near_depth(scene: Scene) -> float | None:
    """Return the 1 % quantile of the depths of all points that training views observe, in scene units.

    Validation views count as training views.  If the dataset does not contain observations, a view observes all
    points inside its image.  Returns None if no view observes a point.
    """
    views = scene.merge_validation().split("train")
    with np.errstate(all="ignore"):  # a damaged file may contain huge points
        visible_depths = [depths[depths < np.inf] for depths in (_observed_depths(scene, view) for view in views)]
    return float(np.quantile(np.concatenate(visible_depths), NEAR_QUANTILE)) if any(map(len, visible_depths)) else None


def _observed_depths(scene: Scene, view: View) -> NDArray[np.floating]:
    """Return the depths of the points that a view observes, [K] scene units."""
    if scene.tracks is None:
        return points_in_image(view, scene.points)
    points = scene.tracks.positions[scene.tracks.rows.get(view.name, [])]
    depths = points @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3]
    return np.asarray(depths[depths > 0])


def points_in_image(view: View, cloud: PointCloud | None) -> NDArray[np.float64]:
    """Return the depths of the points inside the image of a view, [K] scene units.  Large clouds are sampled."""
    points = np.zeros((0, 3)) if cloud is None else cloud.positions
    points = np.asarray(points[:: 1 + len(points) // MAX_POINTS], np.float64)
    x, y, z = np.einsum("ij,nj->in", view.world_to_camera[:, :3], points) + view.world_to_camera[:, 3:]
    z = np.where(z > 0, z, np.inf)
    column, row = (view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy)
    is_inside = np.isfinite(z) & (column >= 0) & (column < view.camera.width) & (row >= 0) & (row < view.camera.height)
    return np.asarray(z[is_inside])


def near_plane(scene: Scene) -> float:
    """Return the distance of the near plane for `model.near: auto`, scene units.

    It is 4 % of the extent (0.2 for an extent of 5), or half of `near_depth` if that is less.  It is rounded to three
    digits, so that it is the same on every machine.
    """
    depth = near_depth(scene)
    return float(f"{min(NEAR_FRACTION * scene.extent, np.inf if depth is None else depth / 2):.3g}")


# Sharpness of photographs.

MIN_SHARPNESS = 0.25  # times the median of a set; sharp photographs reach 0.4 or more, a blur of 1 px only 0.05 to 0.09
SIDE = 480  # px: sharpness is measured at this size, since noise looks like detail at full size


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of a gray image, [H, W], in squared gray levels."""
    return float(cv2.Laplacian(gray, cv2.CV_64F).var())


def sharpness_values(gray: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the sharpness of a gray image, [H, W], and the sharpness divided by the squared mean gray value, [2].

    The second value does not depend on the brightness.
    """
    value = sharpness(gray)
    return np.array([value, value / max(float(gray.mean()), 1.0) ** 2])


def measure_sharpness(path: Path) -> NDArray[np.float64]:
    """Return both sharpness values, [2], of a photograph reduced to SIDE px.  Raises DataError if it is unreadable."""
    return sharpness_values(read_gray(path, SIDE)[0])


def is_blurred(values: NDArray[np.float64], median: NDArray[np.float64]) -> bool:
    """Return whether both sharpness values of a photograph are far below the medians of a set of photographs, [2].

    The first value is also small for a dark photograph, the second for a bright photograph among dark ones.
    """
    return bool((values < MIN_SHARPNESS * median).all())


# Blank photographs, and masks that exclude everything.

DARK, PLAIN = 8, 2  # of 255: largest level of a black image, and largest range of levels in a plain image


def is_blank(pixels: NDArray[Any]) -> bool:
    """Return whether an image, [H, W] or [H, W, C], is black, of one color, or transparent everywhere."""
    scale = 255 / np.iinfo(pixels.dtype).max
    channels = pixels.reshape(*pixels.shape[:2], -1)
    if channels.shape[2] == 4 and not channels[:, :, 3].all():  # the outline of a silhouette is visible
        return not channels[:, :, 3].any()
    for sample in (channels[::16, ::16, :3], channels[:, :, :3]):  # the sparse sample usually suffices
        low, high = sample.min(axis=(0, 1)) * scale, sample.max(axis=(0, 1)) * scale
        if high.max() >= DARK and (high - low).max() > PLAIN:
            return False
    return True


def excludes_all(layer: NDArray[Any]) -> bool:
    """Return whether a mask, [H, W], excludes every pixel."""
    return bool(layer.max() <= MIN_WHITE * np.iinfo(layer.dtype).max)


# Transparency of photographs.

SAMPLED_PHOTOGRAPHS = 3  # several training photographs, since the object may fill one


def is_transparent(scene: Scene) -> bool:
    """Return whether any sampled training photograph has transparent pixels that are not masked.  Raises DataError."""
    return any(map(_is_transparent, sample_views(scene.split("train"), SAMPLED_PHOTOGRAPHS)))


def has_visible_background(scene: Scene) -> bool:
    """Return whether any sampled training photograph can be composited on another background.

    Photographs with masks cannot.  Raises DataError when a file cannot be read.
    """
    return any(load_transparency(view) is not None for view in sample_views(scene.split("train"), SAMPLED_PHOTOGRAPHS))


def opaque_pixels(view: View) -> NDArray[np.bool_] | None:
    """Return a mask, [H, W], of the opaque, unmasked pixels of a photograph, or None if these are all pixels.

    Raises DataError when a file cannot be read.
    """
    transparency, is_unmasked = load_transparency(replace(view, mask_path=None)), load_mask(view)
    masks = [mask for mask in (None if transparency is None else transparency == 0, is_unmasked) if mask is not None]
    return np.logical_and.reduce(masks) if masks else None


def _is_transparent(view: View) -> bool:
    transparency, is_unmasked = load_transparency(replace(view, mask_path=None)), load_mask(view)
    return transparency is not None and bool((transparency if is_unmasked is None else transparency[is_unmasked]).any())
