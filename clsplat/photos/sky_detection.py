"""Detect the sky in photographs: pixels that are bright or blue, smooth, far from all points, connected to the upper
edge, and above the horizon (ours)."""

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
MIN_DISTANCE = 4  # px of a reduced photograph, to the nearest point: 20 px of a photograph of 800
MIN_BRIGHTNESS = 0.6  # mean of the channels
MIN_BLUE_MINUS_RED = 0.03
MIN_BLUE = 0.3
MAX_DEVIATION = 0.04  # standard deviation of the brightness in a square of 3 px
UPPER = 1 / 3  # fraction of a photograph's height
MIN_COUNTED = 1 / 3  # of the upper third: smallest number of pixels of which the sky is a fraction, despite masks
MIN_SKYWARD = 0.75  # fraction of the sky pixels above the horizon; with fewer, they are a wall or a table
GROWTH = 2  # texels around observed sky that count as sky, since pixels near points were left out
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
        """The fraction of sky among the unmasked pixels of the upper third; 0 if most of it is below the horizon."""
        if not self.mask.any() or (self.directions[self.mask] @ self.up > 0).mean() < MIN_SKYWARD:
            return 0.0
        rows = slice(max(1, round(len(self.mask) * UPPER)))
        return float(self.mask[rows].sum() / max(self.unmasked[rows].sum(), MIN_COUNTED * self.unmasked[rows].size))

    @property
    def upper(self) -> Image:
        """The unmasked pixels of the upper third, [K, 3]."""
        rows = slice(max(1, len(self.image) // 3))
        return np.asarray(self.image[rows][self.unmasked[rows]])

    @property
    def directions(self) -> NDArray[np.float64]:
        """The ray directions of the pixels in the scene, [height, width, 3], not normalized."""
        height, width = self.mask.shape
        camera, rotation = self.view.camera, self.view.world_to_camera[:, :3].astype(np.float64)
        x = ((np.arange(width) + 0.5) * camera.width / width - camera.cx) / camera.fx
        y = ((np.arange(height) + 0.5) * camera.height / height - camera.cy) / camera.fy
        return np.asarray(x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2]))


def detect_sky(scene: Scene, views: Iterable[tuple[View, Image, Mask | None]]) -> Iterator[SkyEvidence]:
    """Yield the sky pixels of photographs, [height, width, 3], among unmasked pixels, [height, width]; None: all."""
    up = up_direction(scene.split("train"))
    for view, image, unmasked in views:
        small = _reduce(image)
        usable = np.ones(small.shape[:2], bool) if unmasked is None else _reduce(255 * unmasked.astype(np.uint8)) == 255
        mask = sky_mask(small, _points_in(scene, view) * (small.shape[1] / view.camera.width), usable)
        yield SkyEvidence(view, small, mask, usable, up)


def panorama(photos: Sequence[SkyEvidence], side: int) -> tuple[NDArray[np.float32], Mask] | None:
    """Return the initial colors of an environment map, [side * side, 3], and which texels are sky, [side * side].

    A texel is sky if a photograph shows sky in or near it, or if no photograph shows it.  Its color is the mean of its
    sky pixels, or that of all sky pixels if it has none.  Returns None if no photograph shows sky.
    """
    colors, sky_weights, weights = np.zeros((side**2, 3)), np.zeros(side**2), np.zeros(side**2)
    for photo in photos:
        position = texel_positions(photo.directions, side)
        first = np.floor(position).astype(np.int64)
        texels, weight = bilinear_texels(first[..., 0], first[..., 1], side), bilinear_weights(position - first)
        weights += np.bincount(texels[photo.unmasked].ravel(), weight[photo.unmasked].ravel(), side**2)
        texels, weight = texels[photo.mask], weight[photo.mask]
        sky_weights += np.bincount(texels.ravel(), weight.ravel(), side**2)
        values = photo.image[photo.mask].astype(np.float64) / 255
        for channel in range(3):
            weighted = weight * values[:, channel, None]
            colors[:, channel] += np.bincount(texels.ravel(), weighted.ravel(), side**2)
    if not sky_weights.any():
        return None
    is_sky = sky_weights > 0
    for _ in range(GROWTH):
        is_sky = np.asarray(is_sky[neighbor_texels(side)].any(axis=1))
    mean = colors.sum(axis=0) / sky_weights.sum()
    filled = np.where(sky_weights[:, None] > 0, colors / np.maximum(sky_weights, 1e-9)[:, None], mean)
    return filled.astype(np.float32), is_sky | (weights == 0)


def sky_mask(image: Image, points: NDArray[np.floating], unmasked: Mask) -> Mask:
    """Return which unmasked pixels of a reduced photograph show the sky, [height, width].

    points: [K, 2] px.  Below masked pixels at the upper edge, the sky begins where they end.
    """
    values = image.astype(np.float32) / 255
    brightness = values.mean(axis=2)
    mean = _blur(brightness, unmasked)
    spread = np.sqrt(np.maximum(_blur(brightness**2, unmasked) - mean**2, 0))
    blue = (values[..., 2] > values[..., 0] + MIN_BLUE_MINUS_RED) & (values[..., 2] > MIN_BLUE)
    sky = ((brightness > MIN_BRIGHTNESS) | blue) & (spread < MAX_DEVIATION) & _far_from_points(points, brightness.shape)
    connected = (sky & unmasked) | np.logical_and.accumulate(~unmasked, axis=0)
    _, parts = cv2.connectedComponents(connected.astype(np.uint8), connectivity=4)
    return np.asarray(sky & unmasked & np.isin(parts, parts[0][connected[0]]))


def _blur(values: NDArray[np.float32], unmasked: Mask) -> NDArray[np.float32]:
    """Return the mean of the unmasked pixels in a 3 px square around each pixel."""
    if unmasked.all():
        return np.asarray(cv2.blur(values, (3, 3)))
    fractions = cv2.blur(unmasked.astype(np.float32), (3, 3))
    return np.asarray(cv2.blur(values * unmasked, (3, 3)) / np.maximum(fractions, 0.1), np.float32)


def _far_from_points(points: NDArray[np.floating], shape: tuple[int, ...]) -> Mask:
    """Return which pixels are far from all points."""
    free = np.ones(shape, np.uint8)
    column, row = np.floor(points).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    free[row[inside], column[inside]] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > MIN_DISTANCE)


def _points_in(scene: Scene, view: View) -> NDArray[np.float64]:
    """Return the positions of the dataset's points in a photograph, [K, 2] px; with tracks, only visible points."""
    if scene.tracks is not None and view.name in scene.tracks.rows:
        positions = scene.tracks.positions[scene.tracks.rows[view.name]]
    else:
        positions = scene.points.positions if scene.points is not None else np.zeros((0, 3))
    camera, pose = view.camera, view.world_to_camera.astype(np.float64)
    x, y, z = pose[:, :3] @ positions.astype(np.float64).T + pose[:, 3:]
    in_front = z > 0
    pixels = camera.fx * x[in_front] / z[in_front] + camera.cx, camera.fy * y[in_front] / z[in_front] + camera.cy
    return np.stack(pixels, axis=1)


def _reduce(image: Image) -> Image:
    factor = SIDE / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
