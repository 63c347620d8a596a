"""Depths that are known at some pixels of the training photographs: of the points that they show, or of depth maps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device
from clsplat.render.camera import DeviceCamera
from clsplat.scene.tracks import Tracks
from clsplat.views.depth_maps import DepthMaps

SURE = 4  # photographs that show a point whose depth counts whole; those of fewer count less


@dataclass(frozen=True)
class KnownDepths:
    """Depths at pixels of one view, on the device."""

    pixels: Array  # [K] places in a plane [rows, stride], each once
    inverse: Array  # [K] 1 / depth, scene units⁻¹
    weights: Array  # [K] in (0, 1]
    extent: float  # of the scene, scene units: makes the loss free of units


class PointDepths:
    """The points that structure from motion has found in each training view, by the number of the view.

    maps: are compared with in the place of the points, which they are fitted to.
    """

    def __init__(
        self, device: Device, tracks: Tracks, names: Sequence[str], extent: float, maps: DepthMaps | None = None
    ) -> None:
        self.device, self.tracks, self.names, self.extent, self.maps = device, tracks, names, extent, maps
        self._rows = [tracks.seen.get(name, np.empty(0, np.int64)) for name in names]
        counts = np.bincount(np.concatenate([*tracks.seen.values(), np.empty(0, np.int64)]))
        self._counts = np.pad(counts, (0, len(tracks.positions) - len(counts)))
        self._held: dict[tuple[int, int, int], KnownDepths | None] = {}

    def at(self, camera: DeviceCamera) -> KnownDepths | None:
        """Return what is known at the size of a camera with a number; None where nothing is.

        Raises DataError where a depth map cannot be read.
        """
        if camera.view is None:
            return None
        key = camera.view, camera.width, camera.height
        if key not in self._held:
            self._held[key] = self._uploaded(camera, self._rows[camera.view])
        return self._held[key]

    def _uploaded(self, camera: DeviceCamera, rows: NDArray[np.int64]) -> KnownDepths | None:
        places, depths, kept = nearest_in_pixels(camera, self.tracks.positions[rows])
        inverse: NDArray[np.floating] = 1 / depths
        weights = np.minimum(1.0, self._counts[rows[kept]] / SURE)
        if self.maps and camera.view is not None:
            pixels = places // camera.stride, places % camera.stride
            found = self.maps.at(self.names[camera.view], (camera.width, camera.height), *pixels, inverse)
            if found is None:
                return None
            places, inverse, weights = found[0] * camera.stride + found[1], found[2], np.ones(len(found[2]))
        if not len(places):
            return None
        upload, values = self.device.upload, (inverse.astype(np.float32), weights.astype(np.float32))
        return KnownDepths(upload(places.astype(np.uint32)), upload(values[0]), upload(values[1]), self.extent)


def nearest_in_pixels(
    camera: DeviceCamera, positions: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.floating], NDArray[np.intp]]:
    """Return the places in a plane that positions [M, 3] fall on, ascending [K], their depths and their rows.

    Of those in one pixel the nearest one stays, the first of equal ones; those outside the image are left out.
    """
    values = camera.values
    pose = np.asarray(values["world_to_camera"], np.float64).reshape(3, 4)
    x, y, z = np.einsum("ij,nj->in", pose[:, :3], positions) + pose[:, 3:]  # no sum depends on threads
    in_front = z > 0
    depth = np.where(in_front, z, 1.0)
    column = np.floor(float(values["fx"]) * x / depth + float(values["cx"]))
    row = np.floor(float(values["fy"]) * y / depth + float(values["cy"]))
    shown = in_front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    rows = np.flatnonzero(shown)
    places = (row[rows] * camera.stride + column[rows]).astype(np.intp)
    order = np.lexsort((rows, depth[rows], places))
    _, first = np.unique(places[order], return_index=True)
    kept = order[first]
    return places[kept], depth[rows[kept]], rows[kept]
