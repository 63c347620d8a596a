"""Reuse device memory between frames."""

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.core.errors import MemoryLimitError
from clsplat.opencl.device import Array, Device
from clsplat.opencl.plan import Plans

GROWTH_FACTOR = 1.25  # factor on the requested length when an array grows


class Workspace:
    """Named arrays, each of which keeps its buffer until it must grow, and plans of launches that use them."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.plans = Plans(device)
        self._arrays: dict[str, Array] = {}

    def array(
        self, name: str, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32, slack: float = GROWTH_FACTOR
    ) -> Array:
        """Return an array of this shape; its values are undefined.

        slack: factor on its length if it must grow.  Raises MemoryLimitError if it does not fit, even without slack.
        """
        shape = (shape,) if isinstance(shape, int) else shape
        value_type = np.dtype(dtype)
        length = math.prod(shape)
        array = self._arrays.get(name)
        if array is None or array.nbytes < length * value_type.itemsize:
            is_growing, array = array is not None, None
            self.plans.clear()  # their results contain the old array
            self._arrays.pop(name, None)  # frees the old buffer before the new one is allocated
            array = self._arrays[name] = (
                self._allocate_with_slack(length, value_type, slack)
                if is_growing
                else self.device.zeros(length, value_type)
            )
        return Array(self.device, array.buffer, shape, value_type)

    def upload(self, name: str, values: NDArray[Any]) -> Array:
        """Return an array with values from the host, without waiting for earlier commands, which may still read it.

        values: of 4 bytes each, or structs of them.
        """
        words = self.array(name, values.nbytes // 4, np.uint32)
        array = Array(self.device, words.buffer, values.shape, values.dtype)
        array.set_later(values)
        return array

    def _allocate_with_slack(self, length: int, dtype: np.dtype[Any], slack: float) -> Array:
        """Allocate an array with slack for growth, if the device has enough memory."""
        max_length = self.device.info.allocation // dtype.itemsize
        try:
            return self.device.zeros(max(length, min(int(length * slack), max_length)), dtype)
        except MemoryLimitError:
            return self.device.zeros(length, dtype)

    def length(self, name: str) -> int:
        """Return the number of values in the buffer of `name`; 0 before its first use."""
        return self._arrays[name].shape[0] if name in self._arrays else 0

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self._arrays.values())
