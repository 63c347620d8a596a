"""Cones of pixels, their samples, and the encodings of these, in float64 (Barron et al. 2021, "Mip-NeRF")."""

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.kinds import Camera
from clsplat.conformance.reference.random import philox

Floats = NDArray[np.float64]
BLUR_PADDING, WEIGHT_FLOOR = 0.01, 1e-5  # alpha of equation 18; the released code's least sum
MOST = 1 - float(np.finfo(np.float32).eps)
PIXELS, COARSE, FINE = 8, 9, 10  # which random numbers: cl_kernels/rays.cl


def drawn_pixels(count: int, rays: int, first: int, seed: int, step: int) -> NDArray[np.int64]:
    """A pixel of `count` for each ray of a step from `first` on, [rays]."""
    return np.array([philox((first + i, step, PIXELS, 0), (seed, 0))[0] * count >> 32 for i in range(rays)], np.int64)


def cones(camera: Camera, pixels: NDArray[np.int64]) -> Floats:
    """Origin, direction with depth 1, radius at a distance of 1 and length of the direction, [R, 8]."""
    x = (pixels % camera.width + 0.5 - camera.cx) / camera.fx
    y = (pixels // camera.width + 0.5 - camera.cy) / camera.fy
    rotation, translation = camera.world_to_camera[:, :3], camera.world_to_camera[:, 3]
    directions = np.stack([x, y, np.ones_like(x)], axis=1) @ rotation
    origins = np.broadcast_to(-rotation.T @ translation, directions.shape)
    radii = np.full((len(pixels), 1), 2 / np.sqrt(12) / camera.fx)  # section 3.1
    return np.concatenate([origins, directions, radii, np.linalg.norm(directions, axis=1, keepdims=True)], axis=1)


def units(ray: int, count: int, kind: int, seed: int, step: int) -> Floats:
    """Random numbers in (0, 1] of the edges of a ray, [count]."""
    words = [word for four in range(-(-count // 4)) for word in philox((ray, step, kind, four), (seed, 0))]
    return (np.array(words[:count], np.float64) // 256 + 1) / 2**24


def coarse_edges(near: float, far: float, samples: int, drawn: Floats | None = None) -> Floats:
    """Edges of a ray's coarse samples, [samples + 1]; drawn: [samples + 1] in (0, 1], for training."""
    edges = np.linspace(near, far, samples + 1)
    if drawn is None:
        return edges
    middles = (edges[1:] + edges[:-1]) / 2
    low, high = np.concatenate([edges[:1], middles]), np.concatenate([middles, edges[-1:]])
    return np.asarray(low + (high - low) * drawn)


def fine_edges(edges: Floats, weights: Floats, samples: int, drawn: Floats | None = None) -> Floats:
    """Edges of a ray's fine samples, [samples + 1], where the coarse weights are (equation 18)."""
    padded = np.concatenate([weights[:1], weights, weights[-1:]])
    largest = np.maximum(padded[:-1], padded[1:])
    blurred = (largest[:-1] + largest[1:]) / 2 + BLUR_PADDING
    blurred = blurred + max(0.0, WEIGHT_FLOOR - blurred.sum()) / len(blurred)
    distribution = np.concatenate([[0.0], np.cumsum(blurred / blurred.sum())])
    distribution[-1] = 1.0
    if drawn is None:
        wanted = np.linspace(0, MOST, samples + 1)
    else:
        wanted = np.minimum((np.arange(samples + 1) + drawn) / (samples + 1), MOST)
    return np.interp(wanted, distribution, edges)


def frustums(rays: Floats, edges: Floats) -> tuple[Floats, Floats]:
    """Means and diagonals of the covariances of conical frustums, each [R, N, 3].

    By integrals of powers of the distance over the frustum, and not by the stable form of the kernels (equation 7).
    """
    origins, directions, radii = rays[:, None, :3], rays[:, None, 3:6], rays[:, None, 6:7]
    t0, t1 = edges[:, :-1, None], edges[:, 1:, None]

    def power(n: int) -> Floats:
        return np.asarray((t1 ** (n + 1) - t0 ** (n + 1)) / (n + 1))

    volume = power(2)  # the area of a section grows with the square of the distance
    mean = power(3) / volume
    along = power(4) / volume - mean**2
    across = radii**2 / 4 * power(4) / volume
    squares = directions**2
    diagonal = along * squares + across * (1 - squares / squares.sum(axis=-1, keepdims=True))
    return origins + mean * directions, diagonal


def encoded_frustums(means: Floats, variances: Floats, degrees: int) -> Floats:
    """Means of sines, then of cosines, of 2^l x, [R, N, 6 degrees] (equations 13 and 14)."""
    scales = 2.0 ** np.arange(degrees)[:, None]
    angles = (means[..., None, :] * scales).reshape(*means.shape[:-1], -1)
    falls = np.exp(-0.5 * (variances[..., None, :] * scales**2)).reshape(angles.shape)
    return np.concatenate([falls * np.sin(angles), falls * np.cos(angles)], axis=-1)


def encoded_directions(rays: Floats, degrees: int) -> Floats:
    """Directions of length 1, with their sines and cosines, [R, 3 + 6 degrees]."""
    directions = rays[:, 3:6] / rays[:, 7:8]
    angles = (directions[:, None, :] * 2.0 ** np.arange(degrees)[:, None]).reshape(len(rays), -1)
    return np.concatenate([directions, np.sin(angles), np.cos(angles)], axis=1)
