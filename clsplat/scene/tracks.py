"""Which points of a dataset each photograph shows, and where: what structure from motion has found."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tracks:
    """Points, and the photographs that show them."""

    positions: NDArray[np.floating]  # [M, 3], scene units
    seen: Mapping[str, NDArray[np.int64]]  # rows of `positions`, ascending by id of the point, by the name of a view
    misses: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)  # of the views whose places are known:
    # [K, 2] px of the photograph as it was taken, from where the camera shows each point to where the photograph does

    def renamed(self, names: Mapping[str, str]) -> "Tracks":
        """Return the tracks of some views under other names, by their old ones."""
        seen = {names[old]: rows for old, rows in self.seen.items() if old in names}
        return Tracks(self.positions, seen, {names[old]: one for old, one in self.misses.items() if old in names})
