"""The tables of the colour grids of all photographs on the device."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device
from clsplat.opencl.program import constants

ENTRIES = int(constants("colour_grid.h")["ENTRIES"])
NAMES = ("values", "moment1", "moment2")
Tables = dict[str, NDArray[np.float32]]


class GridTables:
    """The grids of all photographs on the device, with Adam's moments: each [photographs, ENTRIES, nz, ny, nx]."""

    def __init__(self, device: Device, photographs: int, cells: Sequence[int]) -> None:
        """The values are differences from no change, 0 at first.  cells: nx, ny, nz."""
        self.device, self.shape = device, (photographs, ENTRIES, *reversed(cells))
        self.arrays: dict[str, Array] = {name: device.zeros(self.shape) for name in NAMES}

    def fit(self, photographs: int, cells: Sequence[int]) -> bool:
        """Whether they are of so many photographs and of these cells, nx, ny, nz."""
        return self.shape == (photographs, ENTRIES, *reversed(cells))

    def set(self, tables: Mapping[str, NDArray[np.float32]]) -> None:
        """Take tables of a checkpoint; those that it does not have become 0."""
        for name, array in self.arrays.items():
            array.set(np.ascontiguousarray(tables.get(name, np.zeros(self.shape, np.float32))))

    def tables(self, names: Sequence[str] = NAMES) -> Tables:
        """Copy tables to the host."""
        return {name: self.arrays[name].get() for name in names}

    def centre(self) -> None:
        """Subtract the mean over photographs and places at each level of luminance."""
        photographs, _, levels, rows, columns = self.shape
        self.device.program("colour_grid_table.cl").colour_grid_centre(
            groups=ENTRIES * levels,
            values=self.arrays["values"],
            places=rows * columns,
            photographs=photographs,
        )


def row_length(cells: Sequence[int]) -> int:
    """Return the values of one photograph."""
    return ENTRIES * math.prod(cells)


def bytes_of(cells: Sequence[int], photographs: int, rows: int, pixels: int) -> int:
    """Return what grids take on the device.  rows, pixels: of the largest view, whole tiles."""
    row, columns = row_length(cells), ENTRIES * cells[0] * cells[2]
    return 4 * (len(NAMES) * photographs * row + 3 * row + columns * rows + 3 * pixels)
