"""Detect the sky in photographs: bright or blue, even, far from all points, joined to the upper edge, and above the
horizon (ours)."""

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
MIN_DISTANCE = 4  # px there, to the nearest point: 20 px of a photograph of 800
MIN_BRIGHTNESS = 0.6  # mean of the channels
MIN_BLUE_MINUS_RED = 0.03
MIN_BLUE = 0.3
MAX_DEVIATION = 0.04  # standard deviation of the brightness in a square of 3 px
UPPER = 1 / 3  # fraction of a photograph's height
MIN_COUNTED = 1 / 3  # of the upper third: the fraction of sky is of at least this many pixels, as masks may leave few
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
    counted: Mask  # unmasked pixels, [height, width]
    up: NDArray[np.float64]  # in the scene, [3]

    @property
    def share(self) -> float:
        """The fraction of sky among the unmasked pixels of the upper third; 0 if most of it is below the horizon."""
        if not self.mask.any() or (self.directions[self.mask] @ self.up > 0).mean() < MIN_SKYWARD:
            return 0.0
        rows = slice(max(1, round(len(self.mask) * UPPER)))
        return float(self.mask[rows].sum() / max(self.counted[rows].sum(), MIN_COUNTED * self.counted[rows].size))

    @property
    def upper(self) -> Image:
        """The unmasked pixels of the upper third, [K, 3]."""
        rows = slice(max(1, len(self.image) // 3))
        return np.asarray(self.image[rows][self.counted[rows]])

    @property
    def directions(self) -> NDArray[np.float64]:
        """The ray directions of the pixels in the scene, [height, width, 3], not normalized."""
        height, width = self.mask.shape
        camera, turn = self.view.camera, self.view.world_to_camera[:, :3].astype(np.float64)
        x = ((np.arange(width) + 0.5) * camera.width / width - camera.cx) / camera.fx
        y = ((np.arange(height) + 0.5) * camera.height / height - camera.cy) / camera.fy
        return np.asarray(x[None, :, None] * turn[0] + (y[:, None, None] * turn[1] + turn[2]))


def detect_sky(scene: Scene, views: Iterable[tuple[View, Image, Mask | None]]) -> Iterator[SkyEvidence]:
    """Yield the sky pixels of photographs, [height, width, 3], among unmasked pixels, [height, width]; None: all."""
    up = up_direction(scene.split("train"))
    for view, image, counted in views:
        small = _small(image)
        counts = np.ones(small.shape[:2], bool) if counted is None else _small(255 * counted.astype(np.uint8)) == 255
        mask = sky_mask(small, _points_in(scene, view) * (small.shape[1] / view.camera.width), counts)
        yield SkyEvidence(view, small, mask, counts, up)


def panorama(photos: Sequence[SkyEvidence], side: int) -> tuple[NDArray[np.float32], Mask] | None:
    """Return the initial colors of an environment map, [side * side, 3], and which texels are sky, [side * side].

    A texel is sky if a photograph shows sky in or near it, or if no photograph shows it.  Its color is the mean of its
    sky pixels, or else that of all sky pixels.  Returns None if no photograph shows sky.
    """
    colors, of_sky, of_all = np.zeros((side**2, 3)), np.zeros(side**2), np.zeros(side**2)
    for photo in photos:
        position = texel_positions(photo.directions, side)
        first = np.floor(position).astype(np.int64)
        texels, weight = bilinear_texels(first[..., 0], first[..., 1], side), bilinear_weights(position - first)
        of_all += np.bincount(texels[photo.counted].ravel(), weight[photo.counted].ravel(), side**2)
        texels, weight = texels[photo.mask], weight[photo.mask]
        of_sky += np.bincount(texels.ravel(), weight.ravel(), side**2)
        values = photo.image[photo.mask].astype(np.float64) / 255
        for channel in range(3):
            shares = weight * values[:, channel, None]
            colors[:, channel] += np.bincount(texels.ravel(), shares.ravel(), side**2)
    if not of_sky.any():
        return None
    free = of_sky > 0
    for _ in range(GROWTH):
        free = np.asarray(free[neighbor_texels(side)].any(axis=1))
    mean = colors.sum(axis=0) / of_sky.sum()
    filled = np.where(of_sky[:, None] > 0, colors / np.maximum(of_sky, 1e-9)[:, None], mean)
    return filled.astype(np.float32), free | (of_all == 0)


def sky_mask(image: Image, points: NDArray[np.floating], counted: Mask) -> Mask:
    """Return which unmasked pixels of a reduced photograph show the sky, [height, width].

    points: [K, 2] px.  Below masked pixels at the upper edge, the sky begins where they end.
    """
    values = image.astype(np.float32) / 255
    brightness = values.mean(axis=2)
    mean = _blurred(brightness, counted)
    spread = np.sqrt(np.maximum(_blurred(brightness**2, counted) - mean**2, 0))
    blue = (values[..., 2] > values[..., 0] + MIN_BLUE_MINUS_RED) & (values[..., 2] > MIN_BLUE)
    sky = ((brightness > MIN_BRIGHTNESS) | blue) & (spread < MAX_DEVIATION) & _apart(points, brightness.shape)
    joined = (sky & counted) | np.logical_and.accumulate(~counted, axis=0)
    _, parts = cv2.connectedComponents(joined.astype(np.uint8), connectivity=4)
    return np.asarray(sky & counted & np.isin(parts, parts[0][joined[0]]))


def _blurred(values: NDArray[np.float32], counted: Mask) -> NDArray[np.float32]:
    """Return the mean of the unmasked pixels in a 3 px square around each pixel."""
    if counted.all():
        return np.asarray(cv2.blur(values, (3, 3)))
    shares = cv2.blur(counted.astype(np.float32), (3, 3))
    return np.asarray(cv2.blur(values * counted, (3, 3)) / np.maximum(shares, 0.1), np.float32)


def _apart(points: NDArray[np.floating], shape: tuple[int, ...]) -> Mask:
    """Return which pixels are far from all points."""
    free = np.ones(shape, np.uint8)
    column, row = np.floor(points).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    free[row[inside], column[inside]] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > MIN_DISTANCE)


def _points_in(scene: Scene, view: View) -> NDArray[np.float64]:
    """Return the positions of the dataset's points in a photograph, [K, 2] px; only visible points if that is known."""
    if scene.tracks is not None and view.name in scene.tracks.seen:
        positions = scene.tracks.positions[scene.tracks.seen[view.name]]
    else:
        positions = scene.points.positions if scene.points is not None else np.zeros((0, 3))
    camera, pose = view.camera, view.world_to_camera.astype(np.float64)
    x, y, z = pose[:, :3] @ positions.astype(np.float64).T + pose[:, 3:]
    ahead = z > 0
    pixels = camera.fx * x[ahead] / z[ahead] + camera.cx, camera.fy * y[ahead] / z[ahead] + camera.cy
    return np.stack(pixels, axis=1)


def _small(image: Image) -> Image:
    factor = SIDE / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
