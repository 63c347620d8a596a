"""Render a sky and compute its gradients, for runs of pixels (cl_kernels/sky.cl)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.sky import DeviceSky, bilinear_texels, signs, texel_positions
from clsplat.opencl.device import Array, Device, Program, constants
from clsplat.render.camera import CAMERA, DeviceCamera
from clsplat.render.workspace import Workspace

CONSTANTS = constants("sky.cl")
RUN_WORDS, CORNERS, RUN_SUMS, PLACE_BITS, BORDER = (
    int(CONSTANTS[name]) for name in ("RUN_WORDS", "CORNERS", "RUN_SUMS", "PLACE_BITS", "BORDER")
)
CACHE_SIZE = 1 << 28  # bytes of runs on the device
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Runs:
    """The pixels of a camera, grouped by the texels that they interpolate."""

    camera: Array  # [1] camera_t
    runs: Array  # [R, RUN_WORDS] uint32
    strips: Array  # [strips + 1] uint32, first run of each work item
    texels: Array  # [texels] uint32, texels in the view
    first_entry: Array  # [texels + 1] uint32
    entries: Array  # [R * CORNERS] uint32, run * CORNERS + corner, by texel

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self.runs, self.strips, self.texels, self.first_entry, self.entries))


def ray_directions(values: NDArray[np.void], width: int, height: int) -> NDArray[np.float64]:
    """Return unnormalized ray directions through pixel centers, [height, width, 3], scene axes.  values: camera_t."""
    rotation = values["world_to_camera"].reshape(3, 4)[:, :3].astype(np.float64)
    x = (np.arange(width) + 0.5 - np.float64(values["cx"])) / np.float64(values["fx"])
    y = (np.arange(height) + 0.5 - np.float64(values["cy"])) / np.float64(values["fy"])
    return np.asarray(x[None, :, None] * rotation[0] + (y[:, None, None] * rotation[1] + rotation[2]))


def run_words(values: NDArray[np.void], width: int, height: int, side: int) -> Integers:
    """Return the runs of all rows, [R, RUN_WORDS]: adjacent pixels between the same four texels of an octant.

    values: camera_t.
    """
    rays = ray_directions(values, width, height)
    first_texel = np.floor(texel_positions(rays, side)).astype(np.int64)
    octant = (signs(rays) < 0) @ np.array([1, 2, 4])
    key = first_texel[..., 0] + 1 | (first_texel[..., 1] + 1) << PLACE_BITS | octant << 2 * PLACE_BITS
    is_start = np.ones(key.shape, bool)
    is_start[:, 1:] = key[:, 1:] != key[:, :-1]
    row, column = np.nonzero(is_start)
    end = np.append(column[1:], width)
    end[np.append(row[1:] != row[:-1], True)] = width
    corner = first_texel[row, column]
    words = np.column_stack([row, column, end, key[row, column]])
    return np.column_stack([words, bilinear_texels(corner[:, 0], corner[:, 1], side)])


class Skies:
    """Renders skies and computes their gradients; caches the pixel runs of recently used cameras."""

    def __init__(self, device: Device, workspace: Workspace, cache_size: int = CACHE_SIZE) -> None:
        self.device, self.workspace = device, workspace
        self._limit = min(cache_size, device.info.memory // 16)
        self._cache: dict[tuple[int, int], Runs] = {}  # least recently used first
        self._lanes = int(device.tuning["LANES"])

    @property
    def _program(self) -> Program:
        return self.device.program("sky.cl")

    def runs(self, camera: DeviceCamera, side: int) -> Runs:
        """Return the runs of a camera; waits for the device if they are not cached."""
        key = camera.array.buffer.int_ptr, side
        result = self._cache.pop(key, None) or self._compute(camera, side)
        while self._cache and result.nbytes + sum(runs.nbytes for runs in self._cache.values()) > self._limit:
            self._cache.pop(next(iter(self._cache)))
        self._cache[key] = result
        return result

    def _compute(self, camera: DeviceCamera, side: int) -> Runs:
        values = np.asarray(camera.array.get(), CAMERA)[0]
        words = run_words(values, camera.width, camera.height, side)
        texel = words[:, -CORNERS:].ravel()
        entries = np.argsort(texel, kind="stable")
        visible_texels, first_entry = np.unique(texel[entries], return_index=True)
        rows = np.arange(camera.height + 1)
        strips = np.searchsorted(words[:, 0], rows) if self._lanes > 1 else np.arange(len(words) + 1)
        arrays = words, strips, visible_texels, np.append(first_entry, len(entries)), entries
        return Runs(camera.array, *(self.device.upload(array.astype(np.uint32)) for array in arrays))

    def paint(self, sky: DeviceSky, camera: DeviceCamera, image: Array, transmittance: Array) -> None:
        """Add the sky times the transmittance, [rows, stride], to an image, [3 or 4, rows, stride], in place."""
        runs = self.runs(camera, sky.side)
        self._program.sky_forward(
            items=runs.strips.shape[0] - 1,
            runs=runs.runs,
            strips=runs.strips,
            texels=sky.texels,
            camera=camera.array,
            transmittance=transmittance,
            image=image,
            count=runs.strips.shape[0] - 1,
            map_plane=sky.side**2,
            **_sizes(sky, camera),
        )

    def coverage_loss(
        self,
        sky: DeviceSky,
        free: Array,
        camera: DeviceCamera,
        photograph: Array,
        transmittance: Array,
        difference: float,
        scale: float,
    ) -> tuple[Array, Array]:
        """Return T dL/dT of the loss on splats in front of the sky, [1, rows, stride], and row sums of 1 - T, [rows].

        free: [1, side * side], 1 for trained texels, otherwise 0; photograph: [3, rows, stride]; difference: largest
        color difference of a pixel that counts as sky; scale: factor on the loss.
        """
        runs, padded_stride = self.runs(camera, sky.side), camera.stride + 2 * BORDER
        matches = self.workspace.array("sky matches", (camera.rows + 2, padded_stride))
        behind = self.workspace.array("behind", (1, camera.rows, camera.stride))
        sums = self.workspace.array("sky sums", camera.rows)
        matches.fill(0)
        self._program.sky_matches(
            items=runs.strips.shape[0] - 1,
            runs=runs.runs,
            strips=runs.strips,
            texels=sky.texels,
            free=free,
            camera=camera.array,
            photograph=photograph,
            matches=matches,
            difference=difference,
            count=runs.strips.shape[0] - 1,
            map_plane=sky.side**2,
            **_sizes(sky, camera),
        )
        self._program.sky_cover(
            groups=(1, camera.rows),
            matches=matches,
            transmittance=transmittance,
            behind=behind,
            row_sums=sums,
            scale=scale,
            width=camera.width,
            height=camera.height,
            stride=camera.stride,
        )
        return behind, sums

    def grad_texels(self, sky: DeviceSky, camera: DeviceCamera, transmittance: Array, gradient: Array) -> Array:
        """Return the gradient of the texels in the view, [3, texels], from the gradient of the image."""
        runs = self.runs(camera, sky.side)
        count, texel_count = runs.runs.shape[0], runs.texels.shape[0]
        sums, result = (
            self.workspace.array("run sums", (count, RUN_SUMS)),
            self.workspace.array("texels", (3, texel_count)),
        )
        self._program.sky_backward(
            items=count,
            runs=runs.runs,
            camera=camera.array,
            transmittance=transmittance,
            gradient=gradient,
            run_sums=sums,
            count=count,
            **_sizes(sky, camera),
        )
        self._program.sky_gather(
            items=(texel_count, 3),
            run_sums=sums,
            first_entry=runs.first_entry,
            entries=runs.entries,
            grad_texels=result,
            shown=texel_count,
        )
        return result

    def update(
        self, sky: DeviceSky, camera: DeviceCamera, grad_texels: Array, moments: Mapping[str, Array], rate: float
    ) -> None:
        """Update the texels of a view with Adam.

        grad_texels: [3, texels]; moments: `moment1`, `moment2`, [3, side * side], `biases`, [2, side * side],
        and `free`, [1, side * side], 1 for trained texels, otherwise 0.
        """
        runs = self.runs(camera, sky.side)
        self._program.sky_update(
            items=runs.texels.shape[0],
            shown_texels=runs.texels,
            grad_texels=grad_texels,
            texels=sky.texels,
            free=moments["free"],
            moment1=moments["moment1"],
            moment2=moments["moment2"],
            biases=moments["biases"],
            rate=rate,
            pixels=3.0 * camera.width * camera.height,
            map_plane=sky.side**2,
            shown=runs.texels.shape[0],
        )


def _sizes(sky: DeviceSky, camera: DeviceCamera) -> dict[str, Any]:
    return {"half_side": sky.side / 2, "plane": camera.rows * camera.stride, "stride": camera.stride}
