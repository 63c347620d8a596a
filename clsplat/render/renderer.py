"""From Gaussians and a camera to an image, and from the image's gradient back to the Gaussians'."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.model import Gradients, Model
from clsplat.opencl.device import Array, Device
from clsplat.opencl.program import constants
from clsplat.render.tiles import Footprints, Sort, TileLists, Tiler
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import View

RECORD = int(constants()["RECORD"])
MOMENTS = int(constants()["MOMENTS"])
RAY_MARGIN = constants()["RAY_MARGIN"]

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
    """A view's camera on the device, with the size of its planes: whole tiles."""

    array: Array  # [1] camera_t
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    tile: int

    @property
    def tiles(self) -> int:
        return self.tiles_x * self.tiles_y

    @property
    def stride(self) -> int:
        """Columns of a plane."""
        return self.tiles_x * self.tile

    @property
    def rows(self) -> int:
        """Rows of a plane."""
        return self.tiles_y * self.tile


def upload_camera(device: Device, view: View) -> DeviceCamera:
    """Put a view's camera on the device."""
    tile = int(device.tuning["TILE"])
    values = camera_values(view, tile)
    tiles_x, tiles_y = int(values["tiles_x"]), int(values["tiles_y"])
    array = device.upload(values.reshape(1))
    return DeviceCamera(array, view.camera.width, view.camera.height, tiles_x, tiles_y, tile)


def camera_values(view: View, tile: int) -> NDArray[Any]:
    """A view's camera_t, [].

    Rays are clamped 30 % of half the field of view beyond the image's edges (gsplat's off-centre form).
    """
    camera = view.camera
    tiles_x, tiles_y = -(-camera.width // tile), -(-camera.height // tile)
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


@dataclass(frozen=True)
class Frame:
    """What a forward pass leaves behind for the losses and for the backward pass; valid until the next one."""

    camera: DeviceCamera
    splats: Array  # [N, RECORD]
    radius: Array  # [S] px, 0 = not seen
    lists: TileLists
    tile_last: Array  # [T]
    image: Array  # [3, rows, stride], zero outside the image
    transmittance: Array  # [rows, stride]


class Renderer:
    """Renders one frame at a time; its buffers are reused from frame to frame."""

    def __init__(self, device: Device, sort: Sort = "auto") -> None:
        self.device = device
        self.workspace = Workspace(device)
        self.tiler = Tiler(device, self.workspace, sort)
        self._project = device.program("project.cl")
        self._blend = device.program(f"blend_{device.schedule}.cl")
        self._lanes = int(device.tuning["LANES"])
        self._gradients: Gradients | None = None  # made when somebody asks for them

    def forward(self, model: Model, camera: DeviceCamera, background: Array) -> Frame:
        """Render the model.  background: [3]."""
        gaussians, array = model.gaussians, self.workspace.array
        count, stride = gaussians.count, gaussians.capacity
        splats = array("splats", (count, RECORD))
        footprints = Footprints(*(array(field.name, stride, np.uint32) for field in fields(Footprints)))
        radius = array("radius", stride)
        self._project.project_forward(
            items=-(-count // self._lanes),
            **shape_arguments(model, camera),
            sh_base=gaussians["sh_base"],
            splats=splats,
            **vars(footprints),
            radius=radius,
        )
        lists = self.tiler.build(splats, footprints, camera.tiles_x, camera.tiles_y, count)
        image = array("image", (3, camera.rows, camera.stride))
        transmittance = array("transmittance", (camera.rows, camera.stride))
        tile_last = array("tile_last", camera.tiles, np.uint32)
        self._blend.blend_forward(
            groups=camera.tiles,
            tile_offset=lists.tile_offset,
            tile_pairs=lists.tile_pairs,
            pair_splat=lists.pair_splat,
            splats=splats,
            background=background,
            camera=camera.array,
            image=image,
            transmittance=transmittance,
            tile_last=tile_last,
        )
        return Frame(camera, splats, radius, lists, tile_last, image, transmittance)

    def moments(
        self, model: Model, frame: Frame, grad_image: Array, count: int = MOMENTS, texture: Array | None = None
    ) -> Array:
        """Sums over each Gaussian's pixels that its gradients are made of, [count, S]; see cl_kernels/splat.h.

        grad_image: [3, rows, stride], zero outside the image.  More than MOMENTS of them cost more time; the last are
        of `texture`, [rows, stride].
        """
        gaussians, lists = model.gaussians, frame.lists
        defines = {} if count == MOMENTS else {"MOMENTS": count}
        pair_moments = self.workspace.array("pair_moments", (lists.pairs, RECORD))
        self.device.program(f"blend_{self.device.schedule}.cl", **defines).blend_backward(
            groups=frame.camera.tiles,
            tile_offset=lists.tile_offset,
            tile_pairs=lists.tile_pairs,
            pair_splat=lists.pair_splat,
            splats=frame.splats,
            camera=frame.camera.array,
            image=frame.image,
            grad_image=grad_image,
            texture=texture or frame.transmittance,  # without a texture the kernel reads none
            tile_last=frame.tile_last,
            pair_moments=pair_moments,
        )
        moments = self.workspace.array("moments", (count, gaussians.capacity))
        self.device.program("gather.cl", **defines).sum_records(
            items=-(-gaussians.count // self._lanes),
            pair_moments=pair_moments,
            first_pair=lists.first_pair,
            tile_count=lists.tile_count,
            moments=moments,
            stride=gaussians.capacity,
            count=gaussians.count,
        )
        return moments

    def gradients(self, model: Model, frame: Frame, moments: Array) -> Gradients:
        """Derivatives of the loss by every parameter of the model that made the frame; valid until the next ones."""
        if self._gradients is None or self._gradients.capacity != model.gaussians.capacity:
            self._gradients = Gradients(model.gaussians)
        gradients = self._gradients
        self._project.project_backward(
            items=-(-model.gaussians.count // self._lanes),
            **shape_arguments(model, frame.camera),
            splats=frame.splats,
            moments=moments,
            **gradients.arguments(),
        )
        return gradients


def shape_arguments(model: Model, camera: DeviceCamera) -> dict[str, Any]:
    """What every kernel takes that projects Gaussians, by the names of its arguments."""
    gaussians = model.gaussians
    names = ("means", "quats", "log_scales", "logit_opacity", "sh_rest", "filter_variance")
    return {
        **{name: gaussians[name] for name in names},
        "camera": camera.array,
        "near_plane": model.near,
        "screen_variance": model.screen_variance,
        "compensate": model.compensate,
        "degree": model.degree,
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }
