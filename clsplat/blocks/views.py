"""Which views a block is trained on: those that stand in its cell, and those of which it makes a share."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.density.survey import WEIGHT, Look

Floats = NDArray[np.float64]
Why = Literal["place", "sight", "best"]


@dataclass(frozen=True)
class Membership:
    """Which of V views belong to which of B blocks."""

    share: Floats  # [V, B] of a view's pixels that the Gaussians of a cell make, by their blending weight
    inside: NDArray[np.bool_]  # [V, B] whether its camera stands in the cell
    sight: float  # share above which a view belongs to a block

    @property
    def of_views(self) -> NDArray[np.bool_]:
        """The blocks of each view, [V, B]: one at least, that of which it shows most."""
        best = np.arange(self.share.shape[1]) == self.share.argmax(axis=1)[:, None]
        return np.asarray(best | self.inside | (self.share > self.sight))

    @property
    def chosen(self) -> NDArray[np.bool_]:
        """The same, with the view that shows most of it for a block that has none."""
        found = self.of_views
        for block in np.flatnonzero(~found.any(axis=0)):
            found[self.share[:, block].argmax(), block] = True
        return found

    def why(self, view: int, block: int) -> Why:
        """Return the reason for which a view belongs to a block."""
        if self.inside[view, block]:
            return "place"
        return "sight" if self.share[view, block] > self.sight else "best"


def pairs_of(looks: Iterable[Look], count: int, tile: int) -> Floats:
    """Return the (tile, Gaussian) pairs of N = `count` Gaussians over views, [N]: what their training costs.

    It is an estimate by the radius of a splat, which an image's sides bound.
    """
    total = np.zeros(count)
    for look in looks:
        camera, radius = look.photograph.camera, look.radius().astype(np.float64)
        sides = [np.minimum(2 * radius / tile + 1, -(-side // tile)) for side in (camera.width, camera.height)]
        total += np.where(radius > 0, sides[0] * sides[1], 0)
    return total


def share_of(look: Look, owner: NDArray[np.int64], blocks: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the share of a view's pixels that the Gaussians of each block make, [B], and which are seen, [N].

    owner: the block of each Gaussian, [N].  Pixels that a mask leaves out do not count.
    """
    weight = look.sum(WEIGHT)
    pixels = max(int(look.counted().sum()), 1)
    return np.bincount(owner, weight.astype(np.float64), blocks) / pixels, weight > 0
