"""Defer Adam updates of the SH bands above 0 until a view sees their Gaussians.

The update of a value with zero gradient depends only on the value, its moments, and the factors of the step.  The
updates of a block of rows that no view sees are therefore recorded, and applied in order when a view sees the block.
The results are bit-identical to those of immediate updates.  Only `sh_rest` is deferred: 45 of the 59 values of a
Gaussian of SH degree 3, or 76 %.  Means, scales, quaternions, and opacities are not deferred, because they determine
which Gaussians are visible, and their moments keep changing them.
"""

from typing import Any, ClassVar

import numpy as np

from clsplat.formats.splats import sh_coefficients
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.sh_offload import slot_arguments, slot_defines
from clsplat.gaussians.structs import HARMONICS
from clsplat.opencl.device import Array

MAX_UPDATES = 32  # deferred at most; then all rows are updated in one pass


class DeferredHarmonics:
    """The deferred updates of `sh_rest` and its moments.

    Code that reads rows outside the current view must call `flush` first, as `Gaussians` does.
    """

    names: ClassVar[tuple[str, ...]] = HARMONICS

    def __init__(self, gaussians: Gaussians, max_updates: int = MAX_UPDATES) -> None:
        """max_updates: number of recorded updates after which all are applied.  It does not affect the results."""
        device = gaussians.device
        self.gaussians, self.max_updates = gaussians, max_updates
        self.updates = 0  # recorded since the last flush
        self._degree = 0  # SH degree of the recorded updates
        self._lanes = int(device.tuning["LANES"])
        self._factors = device.zeros((max_updates, 2))
        self._visible = device.zeros(self._lanes, np.uint32)  # replaces the depth keys of a view, for all blocks
        self._updates = device.zeros(self._block_count, np.uint32)  # updates applied to each block

    @property
    def _block_count(self) -> int:
        return self.gaussians.capacity // self._lanes

    def array(self, name: str) -> Array:
        """Return a table from `names`, [components, S], without applying deferred updates."""
        return self.gaussians.tables[name].array

    def flush_visible(self, depth_key: Array) -> None:
        """Apply the deferred updates of visible blocks.  depth_key: [S], all bits set for culled Gaussians."""
        if self.updates:
            self._replay(depth_key, every=0)

    def flush(self) -> None:
        """Apply deferred updates of all rows."""
        if self.updates:
            on_host = self.gaussians.on_host
            for _ in on_host.load_parts() if on_host else [None]:
                self._replay(self._visible, every=0xFFFFFFFF)
            self._updates.fill(0)
            self.updates = 0

    def prepare(self, degree: int) -> None:
        """Make room for recording an update of the bands up to `degree`.

        All deferred updates are applied if the degree changes or the list is full.
        """
        if self.updates == self.max_updates or degree != self._degree:
            self.flush()
        self._degree = degree
        if self._updates.shape != (self._block_count,):  # rearranged since the last flush
            self._updates = self.gaussians.device.zeros(self._block_count, np.uint32)

    def record(self, depth_key: Array, factors: tuple[float, float]) -> None:
        """Record an update that has already been applied to visible blocks.

        factors: rate and correction2 of adam.h.  `flush_visible` must have been called before, with the same keys.
        """
        self.gaussians.device.program("deferred.cl").note_update(
            items=-(-self.gaussians.count // self._lanes),
            depth_key=depth_key,
            factors=self._factors,
            done=self._updates,
            rate=factors[0],
            correction2=factors[1],
            update=self.updates,
            count=self.gaussians.count,
        )
        self.updates += 1

    def _replay(self, depth_key: Array, every: int) -> None:
        values, moment1, moment2 = (self.array(name) for name in self.names)
        arguments: dict[str, Any] = {"values": values, "moment1": moment1, "moment2": moment2}
        on_host = self.gaussians.on_host
        self.gaussians.device.program("deferred.cl", **slot_defines(self.gaussians)).replay_updates(
            items=-(-self.gaussians.count // self._lanes),
            **arguments,
            **slot_arguments(self.gaussians),
            depth_key=depth_key,
            factors=self._factors,
            done=self._updates,
            every=every,
            updates=self.updates,
            components=3 * (sh_coefficients(self._degree) - 1),
            stride=self.gaussians.capacity,
            count=self.gaussians.count,
        )
        if on_host:
            on_host.start_download()
