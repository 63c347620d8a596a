"""Depth maps that other programs have made of the photographs: one image each, fitted to the points of the scene.

A value is the inverse depth, bright is near, up to a factor and an offset of each map, as networks for single images
give it.  Both come from the points that the photograph shows, by least absolute differences: some points are wrong.
"""

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.scene.images import read_image

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.floating]
FEWEST = 10  # points of a photograph that a map is fitted to
MOST = 32_768  # pixels of a map that are compared
ROUNDS = 20
EXACT = 1e-3  # of the points' own spread: smaller differences weigh no more
TINY = 1e-12  # scene units⁻¹: points that are all as far
FITS = 0.5  # of the points' own spread: a map that leaves more of it does not show these depths


@dataclass(frozen=True)
class DepthMaps:
    """A folder of maps: `a.png`, of 8 or 16 bits and any size, for the photograph a.jpg; deeper ones likewise."""

    folder: Path

    def require(self, names: Iterable[str]) -> None:
        """Raise DataError where one of the photographs has no map."""
        for name in names:
            if not self._file(name).is_file():
                raise DataError(
                    f"{self._file(name)}: no such file; expected the depth map of {name}, or --set another folder"
                )

    def _file(self, name: str) -> Path:
        return (self.folder / name).with_suffix(".png")

    def read(self, name: str, width: int, height: int) -> Floats:
        """Return the map of a photograph by name, [height, width] in [0, 1].  Raises DataError without one."""
        self.require([name])
        pixels = read_image(self._file(name))[:, :, 0]
        values: NDArray[Any] = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
        if values.shape != (height, width):
            values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(values)

    def at(
        self, name: str, size: tuple[int, int], rows: NDArray[np.intp], columns: NDArray[np.intp], inverse: Floats
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats] | None:
        """Return rows, columns and inverse depths at an even grid of pixels of a photograph of size (width, height).

        rows, columns: [K] pixels that points show, with their inverse depths [K].  None, with a warning, where the map
        does not fit to these.  Raises DataError as `read`.
        """
        values = self.read(name, *size)
        found = fitted(values[rows, columns], inverse)
        if found is None:
            LOG.warning("%s: its depth map does not fit to the points that it shows; it is left out", name)
            return None
        step = math.ceil(math.sqrt(values.size / MOST))
        down, across = np.mgrid[step // 2 : size[1] : step, step // 2 : size[0] : step].reshape(2, -1)
        depths = found[0] * values[down, across] + found[1]
        near = depths > 0  # others lie beyond all that the map tells
        return down[near], across[near], depths[near]


def fitted(values: Floats, inverse: Floats) -> tuple[float, float] | None:
    """Return factor and offset from values of a map to inverse depths, [K] each; None where they do not go together.

    Least absolute differences, by least squares in turn with weights 1 / difference.
    """
    if len(values) < FEWEST:
        return None
    x, y = np.asarray(values, np.float64), np.asarray(inverse, np.float64)
    spread = float(np.abs(y - np.median(y)).mean())
    weights, factor, offset = np.ones(len(x)), 0.0, 0.0
    for _ in range(ROUNDS):
        total = weights.sum()
        middle_x, middle_y = (weights * x).sum() / total, (weights * y).sum() / total
        square = (weights * (x - middle_x) ** 2).sum()
        factor = float((weights * (x - middle_x) * (y - middle_y)).sum() / square) if square > 0 else 0.0
        offset = float(middle_y - factor * middle_x)
        weights = 1 / np.maximum(np.abs(factor * x + offset - y), EXACT * spread + TINY)
    left = float(np.median(np.abs(factor * x + offset - y)))
    return (factor, offset) if factor > 0 and left <= FITS * spread else None
