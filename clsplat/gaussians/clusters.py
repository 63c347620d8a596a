"""k-means on a device, for the palette of a SOG: the same bits as the host's (clsplat/formats/palette.py)."""

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.tables import ALIGNMENT
from clsplat.opencl.device import Device
from clsplat.opencl.program import constants

FILE = "clusters.cl"
FARTHEST, TOGETHER = constants(FILE)["FARTHEST"], int(constants(FILE)["TOGETHER"])
AT_ONCE = 1024  # vectors of a launch: they stay in a core's cache


class DeviceClusters:
    """Points, [N, c], whole numbers whose sums of c products are below 2^24, on a device.

    Sums of points are below 2^31: 4 million points of the size that a palette uses.
    """

    def __init__(self, device: Device, points: NDArray[np.float32]) -> None:
        self.device, (self.count, self.components) = device, points.shape
        self._stride = max(ALIGNMENT, -(-self.count // ALIGNMENT) * ALIGNMENT)
        planes = np.zeros((self.components, self._stride), np.float32)
        planes[:, : self.count] = points.T
        self._points = device.upload(planes)
        self._norms = np.square(points).sum(axis=1) / 2
        self._program = device.program(FILE)

    def nearest(self, vectors: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the nearest of the vectors [E, c] for each point, the first of equally near ones, and half the squared
        distance."""
        entries = -(-len(vectors) // TOGETHER) * TOGETHER
        padded = np.zeros((entries, self.components), np.float32)
        padded[: len(vectors)] = vectors
        norms = np.full(entries, FARTHEST, np.float32)
        norms[: len(vectors)] = np.square(vectors).sum(axis=1) / 2
        uploaded, norm = self.device.upload(padded), self.device.upload(norms)
        label, apart = self.device.empty(self._stride), self.device.empty(self._stride)
        for first in range(0, entries, AT_ONCE):
            self._program.nearest_vectors(
                items=-(-self.count // int(self.device.tuning["LANES"])),
                points=self._points,
                vectors=uploaded,
                norm=norm,
                label=label,
                apart=apart,
                components=self.components,
                first=first,
                end=min(first + AT_ONCE, entries),
                stride=self._stride,
                count=self.count,
            )
        return label.get()[: self.count].astype(np.int64), apart.get()[: self.count] + self._norms

    def sums(self, labels: NDArray[np.int64], entries: int) -> NDArray[np.int64]:
        """Return the sums of the points that have each label, [entries, c]."""
        sums = self.device.zeros((entries, self.components), np.int32)
        self._program.sum_members(
            items=(self.count, self.components),
            points=self._points,
            label=self.device.upload(labels.astype(np.float32)),
            sums=sums,
            components=self.components,
            stride=self._stride,
            count=self.count,
        )
        return sums.get().astype(np.int64)
