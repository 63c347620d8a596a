"""A field of densities and colours, as a network, and the colours of its rays, forward and backward in float64
(Barron et al. 2021, "Mip-NeRF"; the network is that of Mildenhall et al. 2020)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
DENSITY_BIAS, COLOUR_PADDING = -1.0, 0.001
Weights = list[tuple[Floats, Floats]]  # of each layer: [inputs, outputs], [outputs]
Inputs = list[Floats]  # of each layer, [S, inputs]


@dataclass(frozen=True)
class Network:
    """Layers in their order: `depth` of the trunk, of which the one after `skip` reads the position again, density,
    bottleneck, condition, colour."""

    depth: int
    skip: int | None  # layer whose outputs the position joins

    def forward(self, weights: Weights, position: Floats, direction: Floats) -> tuple[Floats, Floats, Inputs]:
        """Raw colours [S, outputs], raw densities [S, outputs], and the inputs of each layer."""
        inputs, x = [], position
        for i in range(self.depth):
            inputs.append(x)
            x = np.maximum(x @ weights[i][0] + weights[i][1], 0)
            if i == self.skip:
                x = np.concatenate([x, position], axis=1)
        density, bottleneck, condition, colour = weights[self.depth :]
        seen = np.concatenate([x @ bottleneck[0] + bottleneck[1], direction], axis=1)
        hidden = np.maximum(seen @ condition[0] + condition[1], 0)
        inputs += [x, x, seen, hidden]
        return hidden @ colour[0] + colour[1], x @ density[0] + density[1], inputs

    def backward(
        self, weights: Weights, inputs: Inputs, by_colours: Floats, by_densities: Floats
    ) -> tuple[Weights, Floats]:
        """Derivatives by the weights, and by the encoded position, [S, features], from those by the raw outputs."""
        density, bottleneck, condition, colour = weights[self.depth :]
        width = bottleneck[0].shape[1]
        by_hidden = (by_colours @ colour[0].T) * (inputs[-1] > 0)
        by_bottleneck = (by_hidden @ condition[0].T)[:, :width]
        by_outputs = [by_densities, by_bottleneck, by_hidden, by_colours]
        by_x = by_densities @ density[0].T + by_bottleneck @ bottleneck[0].T
        by_position = np.zeros_like(inputs[0])
        for i in reversed(range(self.depth)):
            after = inputs[i + 1]  # with the position, where it joins
            if i == self.skip:
                by_position += by_x[:, weights[i][0].shape[1] :]
            own = by_x[:, : weights[i][0].shape[1]] * (after[:, : weights[i][0].shape[1]] > 0)
            by_outputs.insert(0, own)
            by_x = own @ weights[i][0].T
        return [(x.T @ y, y.sum(axis=0)) for x, y in zip(inputs, by_outputs, strict=True)], by_position + by_x


@dataclass(frozen=True)
class Composite:
    """Rays of samples: raw colours [R, N, 3], raw densities [R, N], lengths of the samples [R, N]; background [3]."""

    raw_colours: Floats
    raw_densities: Floats
    lengths: Floats
    background: Floats

    @property
    def samples(self) -> tuple[Floats, Floats]:
        """Colours [R, N, 3] and densities [R, N] of the samples."""
        colours = (1 + 2 * COLOUR_PADDING) / (1 + np.exp(-self.raw_colours)) - COLOUR_PADDING
        return colours, np.logaddexp(0, self.raw_densities + DENSITY_BIAS)

    def weights(self) -> tuple[Floats, Floats]:
        """Weights of the samples, and what is left behind each, [R, N]."""
        left = np.exp(-np.cumsum(self.samples[1] * self.lengths, axis=1))
        before = np.concatenate([np.ones_like(left[:, :1]), left[:, :-1]], axis=1)
        return before - left, left

    def colours(self) -> Floats:
        """Colours of the rays, [R, 3]."""
        weights = self.weights()[0][..., None]
        return np.asarray((weights * self.samples[0]).sum(axis=1) + (1 - weights.sum(axis=1)) * self.background)

    def backward(self, by_colours: Floats) -> tuple[Floats, Floats]:
        """Derivatives by the raw colours and densities, from those by the colours of the rays, [R, 3]."""
        (colours, _), (weights, left) = self.samples, self.weights()
        part = (colours + COLOUR_PADDING) / (1 + 2 * COLOUR_PADDING)
        by_raw = by_colours[:, None] * weights[..., None] * (1 + 2 * COLOUR_PADDING) * part * (1 - part)
        by_weights = (by_colours[:, None] * (colours - self.background)).sum(axis=-1)
        behind = np.cumsum((weights * by_weights)[:, ::-1], axis=1)[:, ::-1] - weights * by_weights
        slope = 1 / (1 + np.exp(-self.raw_densities - DENSITY_BIAS))
        return by_raw, (left * by_weights - behind) * self.lengths * slope


def update(
    values: Floats,
    moment1: Floats,
    moment2: Floats,
    gradient: Floats,
    rate: float,
    number: int,
    epsilon: float = 1e-8,  # of Adam's paper
) -> tuple[Floats, Floats, Floats]:
    """Adam (Kingma and Ba 2015) at its update `number`: values and both moments."""
    m, v = 0.9 * moment1 + 0.1 * gradient, 0.999 * moment2 + 0.001 * gradient**2
    return values - rate * (m / (1 - 0.9**number)) / (np.sqrt(v / (1 - 0.999**number)) + epsilon), m, v
