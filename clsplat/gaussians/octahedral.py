"""The octahedral map: all directions in a square (Meyer et al. 2010), as cl_kernels/sky.cl describes it."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def signs(directions: NDArray[np.floating]) -> Floats:
    """Return -1 for components below 0 and else 1, [..., 3]."""
    return np.where(directions < 0, -1.0, 1.0)


def places(directions: NDArray[np.floating], side: int) -> Floats:
    """Return where directions, [..., 3] of any length, lie between the centres of texels, [..., 2] from -0.5 on."""
    directions = np.asarray(directions, np.float64)
    sign = signs(directions)
    below = np.minimum(directions[..., 2:], 0)
    folded = directions[..., :2] - sign[..., :2] * below
    inside = folded / np.abs(directions).sum(axis=-1, keepdims=True)
    return np.asarray((inside + 1) * (side / 2) - 0.5, np.float64)


def texel_directions(side: int) -> Floats:
    """Return the directions of the centres of all texels, unit vectors, [side * side, 3], row by row."""
    centres = (2 * np.arange(side) + 1) / side - 1
    v, u = (axis.ravel() for axis in np.meshgrid(centres, centres, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    found = np.stack([u - np.where(u < 0, -fold, fold), v - np.where(v < 0, -fold, fold), z], axis=1)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), np.float64)


def texel_at(i: Integers, j: Integers, side: int) -> Integers:
    """Return the numbers of texels in columns i and rows j, from -1 to `side`: beyond an edge the square goes on at the
    mirrored place of the same edge."""
    beyond = (i < 0) | (i >= side)
    i, j = np.clip(i, 0, side - 1), np.where(beyond, side - 1 - j, j)
    beyond = (j < 0) | (j >= side)
    i, j = np.where(beyond, side - 1 - i, i), np.clip(j, 0, side - 1)
    return j * side + i


def neighbours(side: int) -> Integers:
    """Return the texels about each texel and itself, [side * side, 9]."""
    j, i = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    return np.stack([texel_at(i + right, j + down, side) for down in (-1, 0, 1) for right in (-1, 0, 1)], axis=1)


def corners(i: Integers, j: Integers, side: int) -> Integers:
    """Return the four texels about places whose integer parts are i and j, from -1 to side - 1, [..., 4]."""
    return np.stack([texel_at(i + right, j + down, side) for down in (0, 1) for right in (0, 1)], axis=-1)


def weights(fractions: Floats) -> Floats:
    """Return the bilinear weights of the four texels, [..., 4], of the fractional parts of places, [..., 2]."""
    a, b = fractions[..., 0], fractions[..., 1]
    return np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=-1)


def sampled(texels: NDArray[np.floating], directions: NDArray[np.floating]) -> Floats:
    """Return the values of a map, [side * side, C], in directions [..., 3]: [..., C]."""
    side = int(np.sqrt(len(texels)))
    place = places(directions, side)
    first = np.floor(place).astype(np.int64)
    found = texels[corners(first[..., 0], first[..., 1], side)]
    return np.asarray(np.einsum("...kc,...k->...c", found, weights(place - first)))
