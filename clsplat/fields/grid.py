"""The shape of a grid of features: its levels, and where their entries lie."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.opencl.program import constants
from clsplat.settings import Settings

GRID = constants("grid.cl")
FEATURES = int(GRID["GRID_FEATURES"])
FARTHEST = 1e6  # scene units: the square of a depth divided by that of the least is within float32
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
FIRST_MOST = 1e-4  # size of the first numbers at most (Mueller et al. 2022, section 4)


class GridShape(Settings):
    """A grid of features in several resolutions (Mueller et al. 2022): each corner of a cell has 4 numbers, which are
    learned.

    What is finer than a sample counts less (Barron et al. 2023, Zip-NeRF, section 3.1).  Outside of its cube the
    features are zero.
    """

    levels: Annotated[int, Field(ge=1, le=16)] = 8
    """Resolutions, each finer than the one before by the same factor."""
    coarsest: Annotated[int, Field(ge=1, le=4096)] = 16
    """Cells along a side of the cube in the first level."""
    finest: Annotated[int, Field(ge=1, le=4096)] = 256
    """Cells along a side in the last one; where there is one level, that of `coarsest`."""
    entries: Annotated[int, Field(ge=16, le=1 << 22)] = 1 << 17
    """Entries of a level at most, a power of 2; levels with more corners share them by a hash."""
    corner: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] = Field([-1.5, -1.5, -1.5])
    """Corner of the cube with the least coordinates, scene units."""
    side: Annotated[float, Field(ge=1e-6, le=FARTHEST)] = 3.0
    """Side of the cube, scene units."""

    @model_validator(mode="after")
    def _in_order(self) -> "GridShape":
        if self.finest < self.coarsest:
            raise ValueError(f"expected 'finest' from {self.coarsest} on, as 'coarsest' is; it is {self.finest}")
        if self.levels == 1 and self.finest != self.coarsest:
            raise ValueError("expected one number for 'coarsest' and 'finest' of one level, or 2 levels at least")
        if self.entries & (self.entries - 1):
            raise ValueError(f"expected a power of 2 for 'entries'; {self.entries} is none")
        return self

    @property
    def features(self) -> int:
        """Features of a sample."""
        return FEATURES * self.levels

    @property
    def table(self) -> NDArray[np.uint32]:
        """What kernels read of each level, [levels, 4]: cells along a side, first entry, entries, and 1
        where corners share them."""
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        found, first = [], 0
        for level in range(self.levels):
            cells = round(self.coarsest * growth**level)
            corners = (cells + 1) ** 3
            own = min(corners, self.entries)
            found.append((cells, first, own, int(corners > own)))
            first += own
        return np.array(found, np.uint32)

    @property
    def learned(self) -> int:
        """Numbers of all levels."""
        return FEATURES * int(self.table[:, 2].sum())
