"""Compute images and gradients of the sky, an octahedral environment map, and the loss of Gaussians that cover it.

A map is [side, side, C]: row j, column i.  Directions are [H, W, 3], in scene axes.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.types import PinholeCamera

Entry = tuple[int, int, float]  # row and column of a texel, weight


def rays(camera: PinholeCamera, width: int, height: int) -> NDArray[Any]:
    """Return the directions through the centers of pixels, [H, W, 3], in scene axes."""
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    camera_rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1)
    return camera_rays @ camera.world_to_camera[:, :3]  # each row times the rotation, which is the inverse rotation


def map_entries(direction: NDArray[Any], side: int) -> Iterator[Entry]:
    """Yield the four texels around a direction, [3], with their weights."""
    x, y, z = direction / np.abs(direction).sum()
    if z < 0:
        x, y = (1 - abs(y)) * (-1 if x < 0 else 1), (1 - abs(x)) * (-1 if y < 0 else 1)
    a, b = (x + 1) * side / 2 - 0.5, (y + 1) * side / 2 - 0.5
    first_i, first_j = int(np.floor(a)), int(np.floor(b))
    for j in (first_j, first_j + 1):
        for i in (first_i, first_i + 1):
            row, column = j, i
            if column in (-1, side):  # the map continues with the mirrored half of the edge
                row, column = side - 1 - row, min(max(column, 0), side - 1)
            if row in (-1, side):
                row, column = min(max(row, 0), side - 1), side - 1 - column
            yield row, column, (1 - abs(a - i)) * (1 - abs(b - j))


def sky_image(texels: NDArray[Any], directions: NDArray[Any]) -> NDArray[Any]:
    """Return the values of the map in these directions, [C, H, W]."""
    height, width, _ = directions.shape
    image = np.zeros((texels.shape[2], height, width))
    for v, u in np.ndindex(height, width):
        for row, column, weight in map_entries(directions[v, u], len(texels)):
            image[:, v, u] += weight * texels[row, column]
    return image


def sky_gradient(side: int, directions: NDArray[Any], transmittance: NDArray[Any], grad: NDArray[Any]) -> NDArray[Any]:
    """Return the gradient of sum(grad * T * sky_image) with respect to the texels, [side, side, C].

    grad: [C, H, W]; transmittance T: [H, W].
    """
    grad_texels = np.zeros((side, side, len(grad)))
    for v, u in np.ndindex(*transmittance.shape):
        for row, column, weight in map_entries(directions[v, u], side):
            grad_texels[row, column] += weight * transmittance[v, u] * grad[:, v, u]
    return grad_texels


def sky_mask(sky: NDArray[Any], photograph: NDArray[Any], difference: float) -> NDArray[Any]:
    """Return a mask, [H, W], of pixels with at least 6 sky pixels in their 3 x 3 neighborhood.

    sky, photograph: [3, H, W].  difference: the largest absolute difference of a sky pixel from `sky`, averaged over
    channels.
    """
    matches = np.pad(np.abs(sky - photograph).mean(axis=0) <= difference, 1)
    height, width = photograph.shape[1:]
    counts = sum(matches[v : v + height, u : u + width].astype(int) for v in range(3) for u in range(3))
    return np.asarray(counts) >= 6


def sky_cover(mask: NDArray[Any], transmittance: NDArray[Any], weight: float) -> tuple[float, NDArray[Any]]:
    """Return the loss of Gaussians that cover the sky, and its gradient with respect to the transmittance, [H, W]."""
    mean_weights = mask / mask.size
    return float(weight * (mean_weights * (1 - transmittance)).sum()), -weight * mean_weights
