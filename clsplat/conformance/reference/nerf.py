"""Compute a field of densities and colors, its network, and the colors of rays, with gradients, in float64.

Barron et al. 2021 (Mip-NeRF); the network is that of Mildenhall et al. 2020.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.random import philox
from clsplat.conformance.reference.types import PinholeCamera

Floats = NDArray[np.float64]
DENSITY_BIAS, COLOR_PADDING = -1.0, 0.001
Weights = list[tuple[Floats, Floats]]  # of each layer: [inputs, outputs], [outputs]
Inputs = list[Floats]  # of each layer, [S, inputs]


@dataclass(frozen=True)
class DenseNetwork:
    """A network with `depth` trunk layers, followed by density, bottleneck, condition, and color layers.

    The encoded position is also an input of the layer after `skip`.
    """

    depth: int
    skip: int | None  # layer to whose outputs the position is appended

    def forward(self, weights: Weights, position: Floats, direction: Floats) -> tuple[Floats, Floats, Inputs]:
        """Return raw colors, [S, 3], raw densities, [S, 1], and the inputs of each layer."""
        inputs, x = [], position
        for i in range(self.depth):
            inputs.append(x)
            x = np.maximum(x @ weights[i][0] + weights[i][1], 0)
            if i == self.skip:
                x = np.concatenate([x, position], axis=1)
        density, bottleneck, condition, color = weights[self.depth :]
        condition_input = np.concatenate([x @ bottleneck[0] + bottleneck[1], direction], axis=1)
        hidden = np.maximum(condition_input @ condition[0] + condition[1], 0)
        inputs += [x, x, condition_input, hidden]
        return hidden @ color[0] + color[1], x @ density[0] + density[1], inputs

    def backward(
        self, weights: Weights, inputs: Inputs, grad_colors: Floats, grad_densities: Floats
    ) -> tuple[Weights, Floats]:
        """Return the gradients of the weights and of the encoded position, [S, features]."""
        density, bottleneck, condition, color = weights[self.depth :]
        width = bottleneck[0].shape[1]
        grad_hidden = (grad_colors @ color[0].T) * (inputs[-1] > 0)
        grad_bottleneck = (grad_hidden @ condition[0].T)[:, :width]
        grad_outputs = [grad_densities, grad_bottleneck, grad_hidden, grad_colors]
        grad_x = grad_densities @ density[0].T + grad_bottleneck @ bottleneck[0].T
        grad_position = np.zeros_like(inputs[0])
        for i in reversed(range(self.depth)):
            outputs = inputs[i + 1]  # followed by the position if i is `skip`
            if i == self.skip:
                grad_position += grad_x[:, weights[i][0].shape[1] :]
            grad_layer = grad_x[:, : weights[i][0].shape[1]] * (outputs[:, : weights[i][0].shape[1]] > 0)
            grad_outputs.insert(0, grad_layer)
            grad_x = grad_layer @ weights[i][0].T
        return [(x.T @ y, y.sum(axis=0)) for x, y in zip(inputs, grad_outputs, strict=True)], grad_position + grad_x


@dataclass(frozen=True)
class Composite:
    """The samples of rays: raw colors [R, N, 3], raw densities [R, N], lengths [R, N]; and the background [3]."""

    raw_colors: Floats
    raw_densities: Floats
    lengths: Floats
    background: Floats

    @property
    def samples(self) -> tuple[Floats, Floats]:
        """Colors [R, N, 3] and densities [R, N] of the samples."""
        colors = (1 + 2 * COLOR_PADDING) / (1 + np.exp(-self.raw_colors)) - COLOR_PADDING
        return colors, np.logaddexp(0, self.raw_densities + DENSITY_BIAS)

    def weights(self) -> tuple[Floats, Floats]:
        """Return the weights of the samples, and the transmittance behind each, [R, N]."""
        transmittance = np.exp(-np.cumsum(self.samples[1] * self.lengths, axis=1))
        in_front = np.concatenate([np.ones_like(transmittance[:, :1]), transmittance[:, :-1]], axis=1)
        return in_front - transmittance, transmittance

    def colors(self) -> Floats:
        """Return the colors of the rays, [R, 3]."""
        weights = self.weights()[0][..., None]
        return np.asarray((weights * self.samples[0]).sum(axis=1) + (1 - weights.sum(axis=1)) * self.background)

    def backward(self, grad_colors: Floats) -> tuple[Floats, Floats]:
        """Return the gradients of the raw colors and raw densities.  grad_colors: gradients of rays' colors, [R, 3]."""
        (colors, _), (weights, transmittance) = self.samples, self.weights()
        sigmoid = (colors + COLOR_PADDING) / (1 + 2 * COLOR_PADDING)
        grad_raw = grad_colors[:, None] * weights[..., None] * (1 + 2 * COLOR_PADDING) * sigmoid * (1 - sigmoid)
        grad_weights = (grad_colors[:, None] * (colors - self.background)).sum(axis=-1)
        suffix_sums = np.cumsum((weights * grad_weights)[:, ::-1], axis=1)[:, ::-1] - weights * grad_weights
        slope = 1 / (1 + np.exp(-self.raw_densities - DENSITY_BIAS))
        return grad_raw, (transmittance * grad_weights - suffix_sums) * self.lengths * slope


# Cones of pixels, their samples, and the encodings of the samples.

BLUR_PADDING, WEIGHT_FLOOR = 0.01, 1e-5  # alpha of equation 18; smallest sum in the released code
MAX_UNIT = 1 - float(np.finfo(np.float32).eps)
PIXELS, COARSE, FINE = 8, 9, 10  # streams of random numbers, see cl_kernels/rays.cl


def draw_pixels(count: int, rays: int, first: int, seed: int, step: int) -> NDArray[np.int64]:
    """Draw a pixel index below `count` for each ray of a step, [rays].  first: the index of the first ray."""
    return np.array([philox((first + i, step, PIXELS, 0), (seed, 0))[0] * count >> 32 for i in range(rays)], np.int64)


def cones(camera: PinholeCamera, pixels: NDArray[np.int64], unit: float = 1.0) -> Floats:
    """Return the cones of pixels, [R, 8].

    Columns: origin in units of the field, direction with depth 1, radius at distance 1, and length of the direction.
    """
    x = (pixels % camera.width + 0.5 - camera.cx) / camera.fx
    y = (pixels // camera.width + 0.5 - camera.cy) / camera.fy
    rotation, translation = camera.world_to_camera[:, :3], camera.world_to_camera[:, 3]
    directions = np.stack([x, y, np.ones_like(x)], axis=1) @ rotation
    origins = np.broadcast_to(-rotation.T @ translation / unit, directions.shape)
    radii = np.full((len(pixels), 1), 2 / np.sqrt(12) / camera.fx)  # section 3.1
    return np.concatenate([origins, directions, radii, np.linalg.norm(directions, axis=1, keepdims=True)], axis=1)


def uniform_numbers(ray: int, count: int, stream: int, seed: int, step: int) -> Floats:
    """Return random numbers in (0, 1] for the edges of a ray, [count]."""
    words = [word for block in range(-(-count // 4)) for word in philox((ray, step, stream, block), (seed, 0))]
    return (np.array(words[:count], np.float64) // 256 + 1) / 2**24


def coarse_edges(near: float, far: float, samples: int, offsets: Floats | None = None) -> Floats:
    """Return the edges of a ray's coarse samples, [samples + 1].  offsets: random in (0, 1]; None: evenly spaced."""
    edges = np.linspace(near, far, samples + 1)
    if offsets is None:
        return edges
    middles = (edges[1:] + edges[:-1]) / 2
    low, high = np.concatenate([edges[:1], middles]), np.concatenate([middles, edges[-1:]])
    return np.asarray(low + (high - low) * offsets)


def fine_edges(edges: Floats, weights: Floats, samples: int, offsets: Floats | None = None) -> Floats:
    """Return the edges of a ray's fine samples, [samples + 1], distributed by the coarse weights (equation 18)."""
    padded = np.concatenate([weights[:1], weights, weights[-1:]])
    maxima = np.maximum(padded[:-1], padded[1:])
    blurred = (maxima[:-1] + maxima[1:]) / 2 + BLUR_PADDING
    blurred = blurred + max(0.0, WEIGHT_FLOOR - blurred.sum()) / len(blurred)
    distribution = np.concatenate([[0.0], np.cumsum(blurred / blurred.sum())])
    distribution[-1] = 1.0
    if offsets is None:
        quantiles = np.linspace(0, MAX_UNIT, samples + 1)
    else:
        quantiles = np.minimum((np.arange(samples + 1) + offsets) / (samples + 1), MAX_UNIT)
    return np.interp(quantiles, distribution, edges)


def frustums(rays: Floats, edges: Floats) -> tuple[Floats, Floats]:
    """Return the means and the diagonals of the covariances of conical frustums, each [R, N, 3].

    The reference integrates powers of the distance over the frustum; kernels use the stable form (equation 7).
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


def encode_frustums(means: Floats, variances: Floats, degrees: int) -> Floats:
    """Return the expected sines, then cosines, of 2^l x in each frustum, [R, N, 6 degrees] (equations 13 and 14)."""
    scales = 2.0 ** np.arange(degrees)[:, None]
    angles = (means[..., None, :] * scales).reshape(*means.shape[:-1], -1)
    falloffs = np.exp(-0.5 * (variances[..., None, :] * scales**2)).reshape(angles.shape)
    return np.concatenate([falloffs * np.sin(angles), falloffs * np.cos(angles)], axis=-1)


def encode_directions(rays: Floats, degrees: int) -> Floats:
    """Return unit directions with their sines and cosines, [R, 3 + 6 degrees]."""
    directions = rays[:, 3:6] / rays[:, 7:8]
    angles = (directions[:, None, :] * 2.0 ** np.arange(degrees)[:, None]).reshape(len(rays), -1)
    return np.concatenate([directions, np.sin(angles), np.cos(angles)], axis=1)


# A grid of features at several resolutions, and its gradients.

PRIMES = np.array([1, 2654435761, 805459861], np.uint64)  # equation 4 of Mueller et al. 2022
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])


def grid_positions(means: Floats, variances: Floats, corner: Floats, side: float) -> tuple[Floats, Floats]:
    """Return the means of samples, [S, 3], and the average variance of each, [S], in units of the cube's side."""
    return (means - corner) / side, variances.mean(axis=-1) / side**2


@dataclass(frozen=True)
class HashLevel:
    """A cube of cells³ cells.  If it has more corners than `entries`, corners share entries by a hash."""

    cells: int
    entries: int

    def weights(self, variances: Floats) -> Floats:
        """Return a weight of the level for each sample, [S], close to erf(1 / sqrt(8 v n²)) (Barron et al. 2023)."""
        return np.sqrt(-np.expm1(-4 / np.pi / (8 * variances * self.cells**2)))

    def corners(self, positions: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the table indices of the corners around positions in the cube, and their weights, both [S, 8]."""
        cell = np.clip(np.floor(positions * self.cells), 0, self.cells - 1)
        fraction = positions * self.cells - cell
        sides = cell[:, None].astype(np.int64) + CORNERS
        weights = np.where(CORNERS, fraction[:, None], 1 - fraction[:, None]).prod(axis=-1)
        if (self.cells + 1) ** 3 <= self.entries:
            return sides @ np.array([1, self.cells + 1, (self.cells + 1) ** 2]), weights
        hashes = np.bitwise_xor.reduce(sides.astype(np.uint64) * PRIMES & np.uint64(0xFFFFFFFF), axis=-1)
        return (hashes % np.uint64(self.entries)).astype(np.int64), weights

    def forward(self, table: Floats, positions: Floats, variances: Floats) -> Floats:
        """Return the features of samples, [S, F], from a table, [entries, F]; 0 outside of the cube."""
        entries, weights = self._masked_corners(positions, variances)
        return np.asarray((table[entries] * weights[..., None]).sum(axis=1))

    def backward(self, grad_features: Floats, positions: Floats, variances: Floats) -> Floats:
        """Return the gradients of the table, [entries, F].  grad_features: gradients of the features, [S, F]."""
        entries, weights = self._masked_corners(positions, variances)
        grad_table = np.zeros((self.entries, grad_features.shape[1]))
        np.add.at(grad_table, entries, weights[..., None] * grad_features[:, None])
        return grad_table

    def _masked_corners(self, positions: Floats, variances: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the result of `corners`, with weights of 0 for samples outside the cube."""
        is_inside = np.all((positions >= 0) & (positions <= 1), axis=1)
        entries, weights = self.corners(np.where(is_inside[..., None], positions, 0.5))
        return entries, weights * (is_inside * self.weights(variances))[:, None]
