"""Detect the sky in photographs.

Sky pixels are bright or blue, smooth, far from all points, connected to the upper edge, and above the horizon (ours).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.sky import bilinear_texels, bilinear_weights, neighbor_texels, texel_positions
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.viewpoint import up_direction

SIDE = 160  # px, the longer side of the reduced photographs
MIN_DISTANCE = 4  # distance to the nearest point, px of a reduced photograph; 20 px in a photograph of 800 px
MIN_BRIGHTNESS = 0.6  # mean of the channels
MIN_BLUE_MINUS_RED = 0.03
MIN_BLUE = 0.3
MAX_DEVIATION = 0.04  # standard deviation of the brightness in a square of 3 px
UPPER_FRACTION = 1 / 3  # fraction of a photograph's height
MIN_UNMASKED = 1 / 3  # of the upper third: smallest area to which sky pixels are relative, if fewer are unmasked
MIN_SKYWARD = 0.75  # fraction of the sky pixels above the horizon; if it is smaller, they show a wall or a table
GROWTH = 2  # number of texels around observed sky that count as sky, since pixels near points are excluded
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SkyEvidence:
    """The sky pixels of one photograph."""

    view: View
    image: Image  # small, [height, width, 3]
    mask: Mask  # sky pixels, [height, width]
    unmasked: Mask  # unmasked pixels, [height, width]
    up: NDArray[np.float64]  # in the scene, [3]

    @property
    def sky_fraction(self) -> float:
        """The fraction of sky pixels in the unmasked upper third; 0 if too many sky pixels look below the horizon."""
        if not self.mask.any() or (self.directions[self.mask] @ self.up > 0).mean() < MIN_SKYWARD:
            return 0.0
        rows = slice(max(1, round(len(self.mask) * UPPER_FRACTION)))
        return float(self.mask[rows].sum() / max(self.unmasked[rows].sum(), MIN_UNMASKED * self.unmasked[rows].size))

    @property
    def upper_pixels(self) -> Image:
        """The colors of the unmasked pixels in the upper third of the photograph, [K, 3]."""
        rows = slice(max(1, len(self.image) // 3))
        return np.asarray(self.image[rows][self.unmasked[rows]])

    @property
    def directions(self) -> NDArray[np.float64]:
        """The ray directions of the pixels in scene coordinates, [height, width, 3], not normalized."""
        height, width = self.mask.shape
        camera, rotation = self.view.camera, self.view.world_to_camera[:, :3].astype(np.float64)
        x = ((np.arange(width) + 0.5) * camera.width / width - camera.cx) / camera.fx
        y = ((np.arange(height) + 0.5) * camera.height / height - camera.cy) / camera.fy
        return np.asarray(x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2]))


def detect_sky(scene: Scene, views: Iterable[tuple[View, Image, Mask | None]]) -> Iterator[SkyEvidence]:
    """Yield the sky pixels of photographs.

    views: tuples of a view, its photograph, [height, width, 3], and its unmasked pixels, [height, width], or None for
    all pixels.
    """
    up = up_direction(scene.split("train"))
    for view, image, unmasked in views:
        small = _downscale(image)
        small_mask = (
            np.ones(small.shape[:2], bool) if unmasked is None else _downscale(255 * unmasked.astype(np.uint8)) == 255
        )
        mask = sky_mask(small, _visible_points(scene, view) * (small.shape[1] / view.camera.width), small_mask)
        yield SkyEvidence(view, small, mask, small_mask, up)


def build_sky_map(photos: Sequence[SkyEvidence], side: int) -> tuple[NDArray[np.float32], Mask] | None:
    """Return the initial colors of an environment map, [side * side, 3], and a mask of sky texels, [side * side].

    A texel is sky if a photograph shows sky in or near it, or if no photograph shows it.  Its color is the mean of its
    sky pixels, or the mean of all sky pixels if it has none.  Returns None if no photograph shows sky.
    """
    color_sums, sky_weights, weights = np.zeros((side**2, 3)), np.zeros(side**2), np.zeros(side**2)
    for photo in photos:
        position = texel_positions(photo.directions, side)
        corner = np.floor(position).astype(np.int64)
        texels, weight = bilinear_texels(corner[..., 0], corner[..., 1], side), bilinear_weights(position - corner)
        weights += np.bincount(texels[photo.unmasked].ravel(), weight[photo.unmasked].ravel(), side**2)
        texels, weight = texels[photo.mask], weight[photo.mask]
        sky_weights += np.bincount(texels.ravel(), weight.ravel(), side**2)
        values = photo.image[photo.mask].astype(np.float64) / 255
        for channel in range(3):
            weighted_values = weight * values[:, channel, None]
            color_sums[:, channel] += np.bincount(texels.ravel(), weighted_values.ravel(), side**2)
    if not sky_weights.any():
        return None
    is_sky = sky_weights > 0
    for _ in range(GROWTH):
        is_sky = np.asarray(is_sky[neighbor_texels(side)].any(axis=1))
    mean = color_sums.sum(axis=0) / sky_weights.sum()
    texel_colors = np.where(sky_weights[:, None] > 0, color_sums / np.maximum(sky_weights, 1e-9)[:, None], mean)
    return texel_colors.astype(np.float32), is_sky | (weights == 0)


def sky_mask(image: Image, points: NDArray[np.floating], unmasked: Mask) -> Mask:
    """Return a mask, [height, width], of the unmasked pixels that show the sky in a downscaled photograph.

    points: pixel positions of the dataset's points, [K, 2].  The sky may begin below masked pixels at the upper edge.
    """
    values = image.astype(np.float32) / 255
    brightness = values.mean(axis=2)
    mean = _blur(brightness, unmasked)
    spread = np.sqrt(np.maximum(_blur(brightness**2, unmasked) - mean**2, 0))
    blue = (values[..., 2] > values[..., 0] + MIN_BLUE_MINUS_RED) & (values[..., 2] > MIN_BLUE)
    sky = ((brightness > MIN_BRIGHTNESS) | blue) & (spread < MAX_DEVIATION) & _far_from_points(points, brightness.shape)
    candidates = (sky & unmasked) | np.logical_and.accumulate(~unmasked, axis=0)
    _, labels = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    return np.asarray(sky & unmasked & np.isin(labels, labels[0][candidates[0]]))


def _blur(values: NDArray[np.float32], mask: Mask) -> NDArray[np.float32]:
    """Return the mean of the unmasked pixels in a square of 3 x 3 px around each pixel."""
    if mask.all():
        return np.asarray(cv2.blur(values, (3, 3)))
    fractions = cv2.blur(mask.astype(np.float32), (3, 3))
    return np.asarray(cv2.blur(values * mask, (3, 3)) / np.maximum(fractions, 0.1), np.float32)


def _far_from_points(points: NDArray[np.floating], shape: tuple[int, ...]) -> Mask:
    """Return a mask of size `shape` that is true for pixels far from all points, [K, 2] px."""
    is_far = np.ones(shape, np.uint8)
    column, row = np.floor(points).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    is_far[row[inside], column[inside]] = 0
    return np.asarray(cv2.distanceTransform(is_far, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > MIN_DISTANCE)


def _visible_points(scene: Scene, view: View) -> NDArray[np.float64]:
    """Return the positions, [K, 2] px, of the points with a track in a photograph; without tracks, of all points."""
    if scene.tracks is not None and view.name in scene.tracks.rows:
        positions = scene.tracks.positions[scene.tracks.rows[view.name]]
    else:
        positions = scene.points.positions if scene.points is not None else np.zeros((0, 3))
    camera, pose = view.camera, view.world_to_camera.astype(np.float64)
    x, y, z = pose[:, :3] @ positions.astype(np.float64).T + pose[:, 3:]
    in_front = z > 0
    pixels = camera.fx * x[in_front] / z[in_front] + camera.cx, camera.fy * y[in_front] / z[in_front] + camera.cy
    return np.stack(pixels, axis=1)


def _downscale(image: Image) -> Image:
    factor = SIDE / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
