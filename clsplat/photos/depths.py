"""Read depth maps that other programs created, one image per photograph, and fit them to the points of the scene.

The values of a map are inverse depths (bright is near) up to an unknown scale and offset, as predicted by networks for
monocular depth.  The scale and the offset are fitted to the points that are visible in the photograph.  The fit
minimizes absolute differences, since some points are wrong.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.opencl.device import Array, Device
from clsplat.render.camera import DeviceCamera
from clsplat.scene.images import read_image
from clsplat.scene.lookup import FileLookup
from clsplat.scene.scene import Tracks

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.floating]
MIN_POINTS = 10  # points of a photograph that are required to fit a map
MAX_PIXELS = 32_768  # pixels of a map that are used as supervision
ROUNDS = 20
EXACT = 1e-3  # fraction of the points' spread; smaller differences do not get larger weights
TINY = 1e-12  # scene units⁻¹, against division by zero if all points have the same depth
MAX_RESIDUAL = 0.5  # fraction of the points' spread; a map with a larger residual does not fit


def _png_names(name: str) -> list[str]:
    return [str(PurePosixPath(name).with_suffix(".png"))]


@dataclass(frozen=True)
class DepthMaps:
    """A folder of depth maps.  The map of the photograph `b/a.jpg` is `b/a.png`, with 8 or 16 bits and any size."""

    folder: Path
    _files: dict[str, Path] = field(default_factory=dict, compare=False)

    def require(self, names: Iterable[str]) -> None:
        """Raise DataError if a photograph has no map."""
        new_names = [name for name in names if name not in self._files]
        files = FileLookup(self.folder, self.folder, new_names, _png_names, strict=True)
        for name, file in zip(new_names, files.paths, strict=True):
            if not file.is_file():
                raise DataError(f"{file}: the depth map of {name} is missing; add it, or change the folder of the loss")
        self._files.update(zip(new_names, files.paths, strict=True))

    def read(self, name: str, width: int, height: int) -> Floats:
        """Read the depth map of a photograph, resized to [height, width], with values in [0, 1].

        name: the name of the photograph.  Raises DataError if the map is missing.
        """
        self.require([name])
        pixels = read_image(self._files[name])[:, :, 0]
        values: NDArray[Any] = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
        if values.shape != (height, width):
            values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(values)

    def sample(
        self, name: str, size: tuple[int, int], rows: NDArray[np.intp], columns: NDArray[np.intp], inverse: Floats
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats] | None:
        """Sample a photograph's depth map on a regular grid of pixels; return their rows, columns, and inverse depths.

        size: (width, height) of the photograph; rows, columns, inverse: the pixels of points and their inverse depths,
        each [K].  Logs a warning and returns None if the map does not fit these depths.  Raises DataError like `read`.
        """
        values = self.read(name, *size)
        fit = fit_scale_and_offset(values[rows, columns], inverse)
        if fit is None:
            LOG.warning("%s: ignoring the depth map, which does not fit the points of the photo", name)
            return None
        step = math.ceil(math.sqrt(values.size / MAX_PIXELS))
        y, x = np.mgrid[step // 2 : size[1] : step, step // 2 : size[0] : step].reshape(2, -1)
        depths = fit[0] * values[y, x] + fit[1]
        is_in_range = depths > 0
        return y[is_in_range], x[is_in_range], depths[is_in_range]


def fit_scale_and_offset(values: Floats, inverse: Floats) -> tuple[float, float] | None:
    """Return the scale and the offset that convert values of a depth map to inverse depths, or None if the fit is poor.

    values, inverse: [K].  The fit minimizes absolute differences by iteratively reweighted least squares.
    """
    if len(values) < MIN_POINTS:
        return None
    x, y = np.asarray(values, np.float64), np.asarray(inverse, np.float64)
    spread = float(np.abs(y - np.median(y)).mean())
    weights, scale, offset = np.ones(len(x)), 0.0, 0.0
    for _ in range(ROUNDS):
        total = weights.sum()
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        variance = (weights * (x - mean_x) ** 2).sum()
        scale = float((weights * (x - mean_x) * (y - mean_y)).sum() / variance) if variance > 0 else 0.0
        offset = float(mean_y - scale * mean_x)
        weights = 1 / np.maximum(np.abs(scale * x + offset - y), EXACT * spread + TINY)
    residual = float(np.median(np.abs(scale * x + offset - y)))
    return (scale, offset) if scale > 0 and residual <= MAX_RESIDUAL * spread else None


# Known depths at some pixels of the training photographs, from points or depth maps.

FULL_WEIGHT_VIEWS = 4  # number of photographs that must show a point for its full weight


@dataclass(frozen=True)
class KnownDepths:
    """Known depths at some pixels of one view, on the device."""

    pixels: Array  # [K] indices into a plane [rows, stride], each once
    inverse: Array  # [K] 1 / depth, scene units⁻¹
    weights: Array  # [K] in (0, 1]
    extent: float  # extent of the scene, in scene units, which makes the loss unitless


class PointDepths:
    """The depths of the structure-from-motion points in each training view.

    names: the names of the training views, by index; maps: depth maps to fit to the points and to use instead of them.
    """

    def __init__(
        self, device: Device, tracks: Tracks, names: Sequence[str], extent: float, maps: DepthMaps | None = None
    ) -> None:
        self.device, self.tracks, self.names, self.extent, self.maps = device, tracks, names, extent, maps
        self._rows = [tracks.rows.get(name, np.empty(0, np.int64)) for name in names]
        counts = np.bincount(np.concatenate([*tracks.rows.values(), np.empty(0, np.int64)]))
        self._counts = np.pad(counts, (0, len(tracks.positions) - len(counts)))
        self._cache: dict[tuple[int, int, int], KnownDepths | None] = {}

    def at(self, camera: DeviceCamera) -> KnownDepths | None:
        """Return the known depths for the camera of a training view; None if there are none, or for another camera.

        Raises DataError if a depth map cannot be read.
        """
        if camera.view_index is None:
            return None
        key = camera.view_index, camera.width, camera.height
        if key not in self._cache:
            self._cache[key] = self._upload(camera, self._rows[camera.view_index])
        return self._cache[key]

    def _upload(self, camera: DeviceCamera, rows: NDArray[np.int64]) -> KnownDepths | None:
        indices, depths, order = nearest_in_pixels(camera, self.tracks.positions[rows])
        inverse: NDArray[np.floating] = 1 / depths
        weights = np.minimum(1.0, self._counts[rows[order]] / FULL_WEIGHT_VIEWS)
        if self.maps and camera.view_index is not None:
            pixels = indices // camera.stride, indices % camera.stride
            samples = self.maps.sample(self.names[camera.view_index], (camera.width, camera.height), *pixels, inverse)
            if samples is None:
                return None
            indices, inverse, weights = samples[0] * camera.stride + samples[1], samples[2], np.ones(len(samples[2]))
        if not len(indices):
            return None
        upload, values = self.device.upload, (inverse.astype(np.float32), weights.astype(np.float32))
        return KnownDepths(upload(indices.astype(np.uint32)), upload(values[0]), upload(values[1]), self.extent)


def nearest_in_pixels(
    camera: DeviceCamera, positions: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.floating], NDArray[np.intp]]:
    """Project positions, [M, 3], to pixels, and return the nearest position in each pixel.

    Returns three arrays, [K]: the indices of the pixels in a plane, ascending, and the depth and row of each pixel's
    position.  Among equally near positions, the first is used.  Positions outside the image are dropped.
    """
    values = camera.values
    pose = np.asarray(values["world_to_camera"], np.float64).reshape(3, 4)
    x, y, z = np.einsum("ij,nj->in", pose[:, :3], positions) + pose[:, 3:]  # no sum depends on threads
    in_front = z > 0
    depth = np.where(in_front, z, 1.0)
    column = np.floor(float(values["fx"]) * x / depth + float(values["cx"]))
    row = np.floor(float(values["fy"]) * y / depth + float(values["cy"]))
    is_inside = in_front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    visible = np.flatnonzero(is_inside)
    indices = (row[visible] * camera.stride + column[visible]).astype(np.intp)
    order = np.lexsort((visible, depth[visible], indices))
    _, first = np.unique(indices[order], return_index=True)
    nearest = order[first]
    return indices[nearest], depth[visible[nearest]], visible[nearest]
