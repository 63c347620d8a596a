"""Device memory that frames reuse."""

import math

import numpy as np
from numpy.typing import DTypeLike

from clsplat.opencl.device import Array, Device

GROWTH = 1.25


class Workspace:
    """Arrays by name; a name keeps its buffer until it must grow."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._arrays: dict[str, Array] = {}

    def array(self, name: str, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Return an array of that shape; its values are undefined."""
        shape = (shape,) if isinstance(shape, int) else shape
        kind = np.dtype(dtype)
        length = math.prod(shape)
        held = self._arrays.get(name)
        if held is None or held.nbytes < length * kind.itemsize:
            grown = length if held is None else int(length * GROWTH)
            held = self.device.zeros(grown, kind)
            self._arrays[name] = held
        return Array(self.device, held.buffer, shape, kind)

    def length(self, name: str) -> int:
        """Return the number of values in the buffer of `name`; 0 before its first use."""
        return self._arrays[name].shape[0] if name in self._arrays else 0

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self._arrays.values())
