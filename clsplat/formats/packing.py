"""What compact formats share: quaternions as their three smallest components, an order that compresses, bytes."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

LOG = logging.getLogger("clsplat")
MORTON_BITS = 21  # an axis: three fit into 63 bits
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components beside each, in order
_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3))


def smallest_three(quats: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the index of each unit quaternion's largest component, [N], and the others in order, [N, 3].

    Their sign is that with which the largest is positive.
    """
    largest = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    turned = np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None] * quats
    return largest, turned[rows[:, None], _OTHERS[largest]]


def from_smallest_three(largest: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return unit quaternions [N, 4] from what `smallest_three` returns."""
    quats = np.empty((len(others), 4))
    rows = np.arange(len(others))
    quats[rows[:, None], _OTHERS[largest]] = others
    quats[rows, largest] = np.sqrt(np.maximum(1 - np.square(others).sum(axis=1), 0))
    return quats.astype(np.float32)


def morton_order(means: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the rows [N] along a Morton curve through the box of the means: neighbours get similar numbers."""
    if not len(means):
        return np.zeros(0, np.intp)
    low = means.min(axis=0).astype(np.float64)
    extent = np.maximum(means.max(axis=0) - low, 1e-30)
    cells = np.minimum((means - low) / extent * 2**MORTON_BITS, 2**MORTON_BITS - 1).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits before each of 21 bits."""
    for shift, mask in (*_SPREAD, (2, 0x1249249249249249)):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values


def beyond_bytes(levels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which levels no byte holds, by more than rounding, as the shape of `levels`."""
    return (levels < -0.5) | (levels > 255.5)


def tell_cut(path: Path, name: str, what: str, beyond: NDArray[np.bool_]) -> None:
    """Log how many Gaussians, rows of `beyond`, have values outside of what a format holds."""
    if count := int(beyond.any(axis=1).sum()):
        LOG.warning("%s: %s holds %s; those of %s Gaussians were cut", path, name, what, f"{count:,}")
