"""Adam's updates of the harmonics above band 0 that wait until a view sees their Gaussians.

The update of a value whose gradient is zero depends on nothing but that value, its moments and the factors of the step.
So a block of Gaussians that no view sees keeps its rows, and has those updates when one sees it, in their order: the
bits are those of updates at once.  81 % of the numbers of a Gaussian of degree 3 are such; means, scales, quaternions
and opacities decide what is seen, and move on by their moments while they are not.
"""

from typing import Any, ClassVar

import numpy as np

from clsplat.formats.splats import sh_coefficients
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.sh_offload import slot_arguments, slot_defines
from clsplat.gaussians.structs import HARMONICS
from clsplat.opencl.device import Array

LONGEST = 32  # updates that wait at most; then all rows have theirs, in one pass over the tables


class Deferred:
    """The updates that rows of `sh_rest` and of its moments wait for.

    Whoever reads the tables otherwise than by the rows that a view sees calls `flush` first, as `Gaussians` does.
    """

    names: ClassVar[tuple[str, ...]] = HARMONICS

    def __init__(self, gaussians: Gaussians, longest: int = LONGEST) -> None:
        """longest: updates that wait at most; results do not depend on it."""
        device = gaussians.device
        self.gaussians, self.longest = gaussians, longest
        self.updates = 0  # in the list
        self._degree = 0  # of the harmonics, when they were noted
        self._lanes = int(device.tuning["LANES"])
        self._factors = device.zeros((longest, 2))
        self._all = device.zeros(self._lanes, np.uint32)  # in the place of the keys of a view
        self._done = device.zeros(self._blocks, np.uint32)

    @property
    def _blocks(self) -> int:
        return self.gaussians.capacity // self._lanes

    def array(self, name: str) -> Array:
        """Return one of `names` as it lies: [components, S], in which rows wait."""
        return self.gaussians.tables[name].array

    def catch_up(self, depth_key: Array) -> None:
        """Do what waits for the blocks of rows that a view sees.  depth_key: [S], all ones where it culls."""
        if self.updates:
            self._replay(depth_key, every=0)

    def flush(self) -> None:
        """Do what waits for all rows."""
        if self.updates:
            on_host = self.gaussians.on_host
            for _ in on_host.parts() if on_host else [None]:
                self._replay(self._all, every=0xFFFFFFFF)
            self._done.fill(0)
            self.updates = 0

    def prepare(self, degree: int) -> None:
        """Make room in the list for an update of the bands up to a degree.

        All rows have had what waits where the degree changes, where the list is full, and where rows were moved.
        """
        if self.updates == self.longest or degree != self._degree:
            self.flush()
        self._degree = degree
        if self._done.shape != (self._blocks,):  # whatever moves rows has flushed
            self._done = self.gaussians.device.zeros(self._blocks, np.uint32)

    def record(self, depth_key: Array, factors: tuple[float, float]) -> None:
        """Note an update that the blocks of rows that the view sees have had; factors: rate and correction2 of adam.h.

        They must have been brought up to date by `catch_up`, with the same keys.
        """
        self.gaussians.device.program("deferred.cl").note_update(
            items=-(-self.gaussians.count // self._lanes),
            depth_key=depth_key,
            factors=self._factors,
            done=self._done,
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
            done=self._done,
            every=every,
            updates=self.updates,
            components=3 * (sh_coefficients(self._degree) - 1),
            stride=self.gaussians.capacity,
            count=self.gaussians.count,
        )
        if on_host:
            on_host.begin_to_fetch()
