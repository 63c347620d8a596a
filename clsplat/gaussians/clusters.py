"""k-means on a device, for the palette of a SOG: the same bits as the host's (clsplat/formats/palette.py)."""

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.gaussians import ALIGNMENT, Gaussians
from clsplat.opencl.device import Device, constants

FILE = "clusters.cl"
FARTHEST, TOGETHER = constants(FILE)["FARTHEST"], int(constants(FILE)["TOGETHER"])
BLOCK = 1 << 16  # points on the device at once, where they have many components
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
        label, apart = self._nearest(vectors, np.square(vectors).sum(axis=1) / 2)
        return label, apart + self._norms

    def most_alike(self, vectors: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the vector with the largest product for each point, the first of equal ones; all are any numbers."""
        return self._nearest(vectors, np.zeros(len(vectors), np.float32))[0]

    def _nearest(
        self, vectors: NDArray[np.float32], half_squares: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The vector with the least half square minus product for each point, and that difference."""
        entries = -(-len(vectors) // TOGETHER) * TOGETHER
        padded = np.zeros((entries, self.components), np.float32)
        padded[: len(vectors)] = vectors
        norms = np.full(entries, FARTHEST, np.float32)
        norms[: len(vectors)] = half_squares
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
        return label.get()[: self.count].astype(np.int64), apart.get()[: self.count]

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


def most_alike(device: Device, points: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the vector, of [E, c], with the largest product for each point, of [N, c]; memory is for BLOCK points."""
    blocks = (points[start : start + BLOCK] for start in range(0, len(points), BLOCK))
    return np.concatenate([DeviceClusters(device, block).most_alike(vectors) for block in blocks])


# Gaussians in clusters whose members share values; which cluster, and with which weight, is in tables beside them.

LABEL, WEIGHT = "cluster/label", "cluster/weight"  # [1] a whole number below 2^24, [1] at least 0


def set_clusters(gaussians: Gaussians, labels: NDArray[np.integer], weights: NDArray[np.floating]) -> None:
    """Note the cluster of each Gaussian, [N], and how much it counts there, [N]."""
    for name, column in ((LABEL, labels), (WEIGHT, weights)):
        if name not in gaussians.tables:
            gaussians.add(name, 1)
        gaussians.set(name, column[:, None])


def share(gaussians: Gaussians, name: str) -> None:
    """Replace each row of a table by the weighted mean of its cluster's rows, summed in their order."""
    labels = gaussians.get(LABEL)[:, 0].astype(np.int64)
    order, first = np.argsort(labels, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(labels))])
    gaussians.device.program("members.cl").share_mean(
        items=(len(first) - 1, gaussians.tables[name].components),
        values=gaussians[name],
        weight=gaussians[WEIGHT],
        member=gaussians.device.upload(order.astype(np.uint32)),
        first=gaussians.device.upload(first.astype(np.uint32)),
        stride=gaussians.capacity,
        clusters=len(first) - 1,
    )
