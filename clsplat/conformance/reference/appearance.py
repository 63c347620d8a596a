"""Apply bilateral grids, color matrices and camera responses, and compute their gradients.

Images are [3, H, W].  A grid, [3, 4, nz, ny, nx], contains the differences of matrices [E | b] from the identity.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

WEIGHTS = np.array([0.299, 0.587, 0.114])  # of the luminance, BT.601


def apply_color_grid(image: NDArray[Any], grid: NDArray[Any]) -> NDArray[Any]:
    """Return min(1, c + A [c; 1]) for every pixel c.  A is the grid, interpolated at c's position and luminance."""
    return np.minimum(unclamped_grid_colors(image, grid), 1)


def color_grid_backward(
    image: NDArray[Any], grid: NDArray[Any], gradient: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradients of sum(gradient * output) with respect to image and grid; 0 for clamped values."""
    upstream = np.where(unclamped_grid_colors(image, grid) < 1, gradient, 0)
    grad_image, grad_grid, homogeneous = upstream.copy(), np.zeros(grid.shape), _to_homogeneous(image)
    luminance = np.einsum("a,ahw->hw", WEIGHTS, image)
    levels, is_inside = grid.shape[2] - 1, (luminance > 0) & (luminance < 1)
    for (k, j, i), weight, slope in _corners(image, grid):
        node = grid[:, :, k, j, i]  # [3, 4, H, W]
        grad_image += weight * np.einsum("abhw,ahw->bhw", node[:, :3], upstream)
        grad_luminance = np.einsum("abhw,ahw,bhw->hw", node, upstream, homogeneous)
        grad_image += WEIGHTS[:, None, None] * np.where(is_inside, levels * slope * grad_luminance, 0)
        for a, b in itertools.product(range(3), range(4)):
            np.add.at(grad_grid[a, b], (k, j, i), weight * upstream[a] * homogeneous[b])
    return grad_image, grad_grid


def grid_smoothness(grid: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return the mean squared difference of adjacent nodes, summed over the axes, and its gradient."""
    value, gradient = 0.0, np.zeros(grid.shape)
    for axis in (2, 3, 4):
        difference = np.diff(grid, axis=axis)
        if difference.size:
            value += float((difference**2).mean())
            ends = [(0, 0)] * axis + [(1, 1)] + [(0, 0)] * (4 - axis)
            gradient -= 2 * np.diff(np.pad(difference, ends), axis=axis) / difference.size
    return value, gradient


def center_grids(grids: NDArray[Any]) -> NDArray[Any]:
    """Subtract the mean over photographs and positions from each level.  grids: [photographs, 3, 4, nz, ny, nx]."""
    return grids - grids.mean(axis=(0, 4, 5), keepdims=True)


def _to_homogeneous(image: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([image, np.ones((1, *image.shape[1:]))])


def unclamped_grid_colors(image: NDArray[Any], grid: NDArray[Any]) -> NDArray[Any]:
    """Return c + A [c; 1] for every pixel, without the clamp."""
    matrix = sum(weight * grid[:, :, k, j, i] for (k, j, i), weight, _ in _corners(image, grid))
    return np.asarray(image + np.einsum("abhw,bhw->ahw", matrix, _to_homogeneous(image)))


def _corners(image: NDArray[Any], grid: NDArray[Any]) -> Iterator[tuple[Any, NDArray[Any], NDArray[Any]]]:
    """Yield the nodes around each pixel, their weights, and the derivatives of the weights with respect to luminance.

    Nodes are tuples (k, j, i).  All arrays are [H, W].
    """
    _, _, nz, ny, nx = grid.shape
    _, height, width = image.shape
    y, x = np.mgrid[:height, :width]
    luminance = np.clip(np.einsum("a,ahw->hw", WEIGHTS, image), 0, 1)
    positions = luminance * (nz - 1), (y + 0.5) / height * (ny - 1), (x + 0.5) / width * (nx - 1)
    starts = [np.clip(np.floor(p), 0, max(n - 2, 0)).astype(int) for p, n in zip(positions, (nz, ny, nx), strict=True)]
    for corner in itertools.product((0, 1), repeat=3):
        nodes = [np.minimum(f + step, n - 1) for f, step, n in zip(starts, corner, (nz, ny, nx), strict=True)]
        weights = [p - f if step else 1 - (p - f) for p, f, step in zip(positions, starts, corner, strict=True)]
        slope = (1 if corner[0] else -1) * (nz > 1) * weights[1] * weights[2]
        yield tuple(nodes), np.prod(weights, axis=0), slope


# The colors of a photograph: an affine transform of a render's colors, clamped at white.


def apply_color_matrix(image: NDArray[Any], matrix: NDArray[Any]) -> NDArray[Any]:
    """Return min(1, E c + b) for every pixel."""
    return np.minimum(_transform(image, matrix), 1)


def color_matrix_backward(
    image: NDArray[Any], matrix: NDArray[Any], gradient: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradients of sum(gradient * output) with respect to image and matrix; 0 for clamped values."""
    upstream = np.where(_transform(image, matrix) < 1, gradient, 0)
    grad_image = np.einsum("ab,ahw->bhw", matrix[:, :3], upstream)
    homogeneous = np.concatenate([image, np.ones((1, *image.shape[1:]))])
    return grad_image, np.einsum("ahw,bhw->ab", upstream, homogeneous)


def gain_matrix(exposure: float, red: float, blue: float) -> NDArray[Any]:
    """Return the matrix of a gain and a white balance, [3, 4]; green compensates for the luminance of red and blue."""
    luminance = np.array([0.299, 0.587, 0.114])  # BT.601
    green = -(luminance[0] * red + luminance[2] * blue) / luminance[1]
    return np.column_stack([np.diag(np.exp(exposure + np.array([red, green, blue]))), np.zeros(3)])


def _transform(image: NDArray[Any], matrix: NDArray[Any]) -> NDArray[Any]:
    """Return E c + b for every pixel."""
    return np.asarray(np.einsum("ab,bhw->ahw", matrix[:, :3], image) + matrix[:, 3, None, None])


# The response of a camera to light, 17 parameters: center [2], a, b, c, and four for the curve of each channel.


def apply_response(image: NDArray[Any], row: NDArray[Any], center: tuple[float, float]) -> NDArray[Any]:
    """Return f(v x) for every pixel x, with the curve f and the vignetting v.  center: the principal point, in px."""
    light = image * _falloff(image, row, center)[0]
    return np.stack([_curve(light[i], _slopes(row, i)) for i in range(3)])


def apply_response_backward(
    image: NDArray[Any], row: NDArray[Any], center: tuple[float, float], gradient: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradients of sum(gradient * output) with respect to the image and the 17 parameters."""
    falloff, q, offset = _falloff(image, row, center)
    light, grad_light, grad_row = image * falloff, np.zeros(image.shape), np.zeros(17)
    for i in range(3):
        slopes = _slopes(row, i)
        quarter, d = _locate_quarter(light[i])
        grad_light[i] = gradient[i] * (slopes[quarter] + 4 * (slopes[quarter + 1] - slopes[quarter]) * d)
        grad_slope = np.array([(gradient[i] * _curve(light[i], unit)).sum() for unit in np.eye(5)])
        areas = np.array([_curve(np.ones(1), unit)[0] for unit in np.eye(5)])
        grad_logs = (np.diag(slopes) - np.outer(slopes, areas * slopes)).T @ grad_slope
        grad_row[5 + 4 * i : 9 + 4 * i] = np.delete(grad_logs, 2)
    grad_falloff = (grad_light * image).sum(axis=0)
    grad_row[2:5] = [(grad_falloff * q**power).sum() for power in (1, 2, 3)]
    a, b, c = row[2:5]
    grad_row[:2] = [(grad_falloff * (a + 2 * b * q + 3 * c * q**2) * -2 * axis).sum() for axis in offset]
    return grad_light * falloff, grad_row


def _falloff(
    image: NDArray[Any], row: NDArray[Any], center: tuple[float, float]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the vignetting v, [H, W], the squared radius q, [H, W], and the offset from the center, [2, H, W].

    The unit of length is half the diagonal of the image.
    """
    _, height, width = image.shape
    half = np.hypot(width, height) / 2
    y, x = np.mgrid[:height, :width] + 0.5
    offset = np.stack([(x - center[0]) / half - row[0], (y - center[1]) / half - row[1]])
    q = (offset**2).sum(axis=0)
    return 1 + row[2] * q + row[3] * q**2 + row[4] * q**3, q, offset


def _slopes(row: NDArray[Any], channel: int) -> NDArray[Any]:
    """Return the slopes at 0, 1/4, 1/2, 3/4 and 1 of a curve from 0 to 1."""
    slopes = np.exp(np.insert(row[5 + 4 * channel : 9 + 4 * channel], 2, 0.0))
    return np.asarray(slopes / _curve(np.ones(1), slopes))


def _locate_quarter(x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Clamp values to [0, 1]; return the quarter of [0, 1] that contains each, and the offset in that quarter."""
    inside = np.clip(x, 0, 1)
    quarter = np.minimum((4 * inside).astype(int), 3)
    return quarter, inside - quarter / 4


def _curve(x: NDArray[Any], slopes: NDArray[Any]) -> NDArray[Any]:
    """Integrate slopes from 0 to x.  Slopes are linear between multiples of 1/4, and constant below 0 and above 1."""
    quarter, d = _locate_quarter(x)
    start_value = np.concatenate([[0], np.cumsum(slopes[1:] + slopes[:-1]) / 8])[quarter]
    value = start_value + slopes[quarter] * d + 2 * (slopes[quarter + 1] - slopes[quarter]) * d**2
    return np.asarray(value + slopes[0] * np.minimum(x, 0) + slopes[4] * np.maximum(x - 1, 0))
