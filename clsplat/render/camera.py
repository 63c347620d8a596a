"""Upload the camera of a view, and compute the size of its image planes."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.opencl.device import Array, Device, constants
from clsplat.render.workspace import Workspace
from clsplat.scene.view import View

RAY_MARGIN = constants()["RAY_MARGIN"]
TILES_MAX = 1 << int(constants("tiles.h")["BOX_BITS"])  # largest number of tiles per side
PIXELS_MAX = 2**30  # largest image, in whole tiles: kernels index up to four planes in 32 bits

# camera_t of cl_kernels/common.h
CAMERA = np.dtype(
    [
        ("world_to_camera", np.float32, 12),
        ("position", np.float32, 3),
        *((name, np.float32) for name in ("fx", "fy", "cx", "cy")),
        *((name, np.float32) for name in ("ray_x_min", "ray_x_max", "ray_y_min", "ray_y_max")),
        *((name, np.uint32) for name in ("width", "height", "tiles_x", "tiles_y")),
    ]
)


@dataclass(frozen=True)
class DeviceCamera:
    """A view's camera on the device, and the size of its planes, rounded up to whole tiles."""

    array: Array  # [1] camera_t
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    tile: int
    view_index: int | None = None  # index of the view in the table HIDDEN; None renders all Gaussians
    time: float | None = None  # time in [0, 1] at which moving Gaussians are rendered
    source: View | None = field(default=None, repr=False, compare=False)  # the view that has these values
    values: NDArray[Any] = field(default_factory=lambda: np.zeros((), CAMERA), repr=False, compare=False)  # on the host

    @property
    def size(self) -> tuple[int, ...]:
        """The sizes of the image and its planes, as a part of the keys of plans."""
        return self.width, self.height, self.tiles_x, self.tiles_y

    @property
    def tiles(self) -> int:
        return self.tiles_x * self.tiles_y

    @property
    def stride(self) -> int:
        """The number of columns of a plane."""
        return self.tiles_x * self.tile

    @property
    def rows(self) -> int:
        """The number of rows of a plane."""
        return self.tiles_y * self.tile

    def plane_arguments(self) -> dict[str, int]:
        """Return the plane sizes as kernel arguments, by name."""
        return {"width": self.width, "height": self.height, "rows": self.rows, "stride": self.stride}


def move_camera(
    workspace: Workspace, camera: DeviceCamera, world_to_camera: NDArray[np.floating], zoom: float = 1.0
) -> DeviceCamera:
    """Return a camera with another pose, [3, 4], and focal lengths times `zoom`.  The plane size does not change.

    It is valid until the next call.
    """
    values = camera.values.copy()
    for name in ("fx", "fy"):
        values[name] = float(values[name]) * zoom
    for name in ("ray_x_min", "ray_x_max", "ray_y_min", "ray_y_max"):  # tangents of angles
        values[name] = float(values[name]) / zoom
    values["world_to_camera"] = world_to_camera.ravel()
    values["position"] = -world_to_camera[:, :3].T @ world_to_camera[:, 3]
    return replace(camera, array=workspace.upload("moved camera", values.reshape(1)), values=values, source=None)


def update_camera(camera: DeviceCamera, view: View) -> DeviceCamera:
    """Return `camera` with the values of a view of the same image size.  They are uploaded only if they differ."""
    if view is camera.source:
        return camera
    values = camera_values(view, camera.tile)
    if values == camera.values:
        return replace(camera, source=view)
    return replace(camera, array=camera.array.device.upload(values.reshape(1)), values=values, source=view)


def upload_camera(device: Device, view: View) -> DeviceCamera:
    """Copy a view's camera to the device.  Raises DataError like `camera_values`."""
    tile = int(device.tuning["TILE"])
    values = camera_values(view, tile)
    tiles_x, tiles_y = int(values["tiles_x"]), int(values["tiles_y"])
    array = device.upload(values.reshape(1))
    size = view.camera.width, view.camera.height, tiles_x, tiles_y
    return DeviceCamera(array, *size, tile, time=view.time, source=view, values=values)


def camera_values(view: View, tile: int) -> NDArray[Any]:
    """Return the camera_t of a view, a scalar record.

    Rays are clamped at 30% of half the field of view beyond the image's edges (gsplat's off-center form).  Raises
    DataError if the image has more tiles per side, or more pixels, than kernels can index.
    """
    camera = view.camera
    tiles_x, tiles_y = -(-camera.width // tile), -(-camera.height // tile)
    if max(tiles_x, tiles_y) > TILES_MAX:
        raise DataError(
            f"{view.name}: the camera is {camera.width}x{camera.height} pixels; expected at most {TILES_MAX * tile} "
            "per side on this device; downscale the image"
        )
    if tiles_x * tiles_y * tile**2 > PIXELS_MAX:
        raise DataError(
            f"{view.name}: the camera is {camera.width}x{camera.height} pixels; expected at most {PIXELS_MAX:,} "
            f"after rounding each side up to a multiple of {tile}; downscale the image"
        )
    margin_x = RAY_MARGIN * camera.width / (2 * camera.fx)
    margin_y = RAY_MARGIN * camera.height / (2 * camera.fy)
    values = (
        view.world_to_camera.ravel(),
        view.position,
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        *(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x),
        *(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y),
        *(camera.width, camera.height, tiles_x, tiles_y),
    )
    return np.array(values, CAMERA)
