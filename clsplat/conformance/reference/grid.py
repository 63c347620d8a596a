"""A grid of features in several resolutions, and its derivatives, in float64.

Mueller et al. 2022 (instant-ngp); Barron et al. 2023 (Zip-NeRF).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
PRIMES = np.array([1, 2654435761, 805459861], np.uint64)  # equation 4 of Mueller et al. 2022
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])


def places(means: Floats, variances: Floats, corner: Floats, side: float) -> tuple[Floats, Floats]:
    """Means of samples in the cube, [S, 3] in shares of its side, and the mean of their variances there, [S]."""
    return (means - corner) / side, variances.mean(axis=-1) / side**2


@dataclass(frozen=True)
class Level:
    """A cube of n^3 cells whose corners share `entries` where they are fewer."""

    cells: int
    entries: int

    def weights(self, variances: Floats) -> Floats:
        """How much of a level samples can tell, [S]: nearly erf(1 / sqrt(8 v n^2)) (Barron et al. 2023)."""
        return np.sqrt(-np.expm1(-4 / np.pi / (8 * variances * self.cells**2)))

    def corners(self, at: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Entries of the corners around places in the cube, and their weights, both [S, 8]."""
        cell = np.clip(np.floor(at * self.cells), 0, self.cells - 1)
        within = at * self.cells - cell
        sides = cell[:, None].astype(np.int64) + CORNERS
        shares = np.where(CORNERS, within[:, None], 1 - within[:, None]).prod(axis=-1)
        if (self.cells + 1) ** 3 <= self.entries:
            return sides @ np.array([1, self.cells + 1, (self.cells + 1) ** 2]), shares
        mixed = np.bitwise_xor.reduce(sides.astype(np.uint64) * PRIMES & np.uint64(0xFFFFFFFF), axis=-1)
        return (mixed % np.uint64(self.entries)).astype(np.int64), shares

    def forward(self, table: Floats, at: Floats, variances: Floats) -> Floats:
        """Features of samples, [S, F], of a table of entries, [entries, F]; 0 outside of the cube."""
        entries, shares = self._inside(at, variances)
        return np.asarray((table[entries] * shares[..., None]).sum(axis=1))

    def backward(self, by_features: Floats, at: Floats, variances: Floats) -> Floats:
        """Derivatives by the table, [entries, F], from those by the features."""
        entries, shares = self._inside(at, variances)
        found = np.zeros((self.entries, by_features.shape[1]))
        np.add.at(found, entries, shares[..., None] * by_features[:, None])
        return found

    def _inside(self, at: Floats, variances: Floats) -> tuple[NDArray[np.int64], Floats]:
        """The corners, with the weight of the level; without any outside of the cube."""
        inside = np.all((at >= 0) & (at <= 1), axis=1)
        entries, shares = self.corners(np.where(inside[..., None], at, 0.5))
        return entries, shares * (inside * self.weights(variances))[:, None]
