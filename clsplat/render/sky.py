"""The sky in a frame and its derivatives: cl_kernels/sky.cl, and the runs of pixels that it works on."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.sky import DeviceSky, bilinear_texels, signs, texel_positions
from clsplat.opencl.device import Array, Device, Program, constants
from clsplat.render.camera import CAMERA, DeviceCamera
from clsplat.render.workspace import Workspace

NUMBERS = constants("sky.cl")
RUN_WORDS, CORNERS, RUN_SUMS, PLACE_BITS, BORDER = (
    int(NUMBERS[name]) for name in ("RUN_WORDS", "CORNERS", "RUN_SUMS", "PLACE_BITS", "BORDER")
)
KEPT = 1 << 28  # bytes of runs on the device at most: those of the cameras that were used last
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Runs:
    """The pixels of a camera by the texels that they lie between."""

    camera: Array  # [1] camera_t that they are of
    runs: Array  # [R, RUN_WORDS] uint32
    strips: Array  # [strips + 1] uint32, first run of what one item paints
    shown: Array  # [texels] uint32, those that the camera shows
    first_entry: Array  # [texels + 1] uint32
    entries: Array  # [R * CORNERS] uint32, run * CORNERS + corner, by texel

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self.runs, self.strips, self.shown, self.first_entry, self.entries))


def directions_of(values: NDArray[np.void], width: int, height: int) -> NDArray[np.float64]:
    """Return the directions of the rays through the centers of pixels in the scene, [height, width, 3], of any length.

    values: camera_t.
    """
    turn = values["world_to_camera"].reshape(3, 4)[:, :3].astype(np.float64)
    x = (np.arange(width) + 0.5 - np.float64(values["cx"])) / np.float64(values["fx"])
    y = (np.arange(height) + 0.5 - np.float64(values["cy"])) / np.float64(values["fy"])
    return np.asarray(x[None, :, None] * turn[0] + (y[:, None, None] * turn[1] + turn[2]))


def run_words(values: NDArray[np.void], width: int, height: int, side: int) -> Integers:
    """Return the runs of all rows, [R, RUN_WORDS]: pixels side by side that lie between the same four texels, in one
    octant.  values: camera_t."""
    rays = directions_of(values, width, height)
    first = np.floor(texel_positions(rays, side)).astype(np.int64)
    bits = (signs(rays) < 0) @ np.array([1, 2, 4])
    place = first[..., 0] + 1 | (first[..., 1] + 1) << PLACE_BITS | bits << 2 * PLACE_BITS
    begins = np.ones(place.shape, bool)
    begins[:, 1:] = place[:, 1:] != place[:, :-1]
    row, column = np.nonzero(begins)
    end = np.append(column[1:], width)
    end[np.append(row[1:] != row[:-1], True)] = width
    found = first[row, column]
    words = np.column_stack([row, column, end, place[row, column]])
    return np.column_stack([words, bilinear_texels(found[:, 0], found[:, 1], side)])


class Skies:
    """Paints skies, and sums their gradients; keeps the runs of the cameras that were used last."""

    def __init__(self, device: Device, workspace: Workspace, kept: int = KEPT) -> None:
        self.device, self.workspace = device, workspace
        self._limit = min(kept, device.info.memory // 16)
        self._kept: dict[tuple[int, int], Runs] = {}  # least recently used first
        self._lanes = int(device.tuning["LANES"])

    @property
    def _program(self) -> Program:
        return self.device.program("sky.cl")

    def runs(self, camera: DeviceCamera, side: int) -> Runs:
        """Return the runs of a camera; the first time it waits for the device."""
        key = camera.array.buffer.int_ptr, side
        found = self._kept.pop(key, None) or self._made(camera, side)
        while self._kept and found.nbytes + sum(runs.nbytes for runs in self._kept.values()) > self._limit:
            self._kept.pop(next(iter(self._kept)))
        self._kept[key] = found
        return found

    def _made(self, camera: DeviceCamera, side: int) -> Runs:
        values = np.asarray(camera.array.get(), CAMERA)[0]
        words = run_words(values, camera.width, camera.height, side)
        texel = words[:, -CORNERS:].ravel()
        entries = np.argsort(texel, kind="stable")
        shown, first_entry = np.unique(texel[entries], return_index=True)
        rows = np.arange(camera.height + 1)
        strips = np.searchsorted(words[:, 0], rows) if self._lanes > 1 else np.arange(len(words) + 1)
        arrays = words, strips, shown, np.append(first_entry, len(entries)), entries
        return Runs(camera.array, *(self.device.upload(array.astype(np.uint32)) for array in arrays))

    def paint(self, sky: DeviceSky, camera: DeviceCamera, image: Array, transmittance: Array) -> None:
        """Add what the splats leave, [rows, stride], times the sky to an image, [3 or 4, rows, stride], in place."""
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

    def cover(
        self,
        sky: DeviceSky,
        free: Array,
        camera: DeviceCamera,
        photograph: Array,
        transmittance: Array,
        difference: float,
        scale: float,
    ) -> tuple[Array, Array]:
        """Return T dL/dT of the loss of what covers the sky, [1, rows, stride], and its sums of 1 - T by row, [rows].

        free: [1, side * side] 1 for a texel that is learned, else 0; photograph: [3, rows, stride]; difference: up to
        which a pixel shows the sky; scale: factor of the sums.
        """
        runs, wide = self.runs(camera, sky.side), camera.stride + 2 * BORDER
        matches = self.workspace.array("sky matches", (camera.rows + 2, wide))
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

    def by_texels(self, sky: DeviceSky, camera: DeviceCamera, transmittance: Array, gradient: Array) -> Array:
        """Return derivatives by the texels that the camera shows, [3, shown], from those by the image."""
        runs = self.runs(camera, sky.side)
        count, shown = runs.runs.shape[0], runs.shown.shape[0]
        sums, found = self.workspace.array("run sums", (count, RUN_SUMS)), self.workspace.array("texels", (3, shown))
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
            items=(shown, 3),
            run_sums=sums,
            first_entry=runs.first_entry,
            entries=runs.entries,
            by_texels=found,
            shown=shown,
        )
        return found

    def update(
        self, sky: DeviceSky, camera: DeviceCamera, by_texels: Array, moments: Mapping[str, Array], rate: float
    ) -> None:
        """Change the texels that the camera shows by Adam.

        by_texels: [3, shown]; moments: `moment1`, `moment2`, [3, side * side], `biases`, [2, side * side], and `free`,
        1 for a texel that is learned and else 0, [1, side * side].
        """
        runs = self.runs(camera, sky.side)
        self._program.sky_update(
            items=runs.shown.shape[0],
            shown_texels=runs.shown,
            by_texels=by_texels,
            texels=sky.texels,
            free=moments["free"],
            moment1=moments["moment1"],
            moment2=moments["moment2"],
            biases=moments["biases"],
            rate=rate,
            pixels=3.0 * camera.width * camera.height,
            map_plane=sky.side**2,
            shown=runs.shown.shape[0],
        )


def _sizes(sky: DeviceSky, camera: DeviceCamera) -> dict[str, Any]:
    return {"half_side": sky.side / 2, "plane": camera.rows * camera.stride, "stride": camera.stride}
