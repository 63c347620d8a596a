"""Define the interface of renderers, for Gaussians and fields."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.gaussians import DeviceModel
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.render.workspace import Workspace

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Layers:
    """A rendered view on the host: color, alpha, and depths."""

    image: Floats  # [height, width, 3], with background
    alpha: Floats  # [height, width] in [0, 1]
    depth: Floats | None  # [height, width] scene units, alpha-weighted mean; 0 where alpha is 0
    median_depth: Floats | None = None  # [height, width] scene units, depth at which transmittance falls below ½, or 0
    normals: Floats | None = None  # [height, width, 3] unit, in scene axes, from the mean depth; 0: unknown

    @property
    def arrays(self) -> list[Floats]:
        """All rendered layers."""
        layers = self.image, self.alpha, self.depth, self.median_depth, self.normals
        return [layer for layer in layers if layer is not None]


def render_layers(
    rasterizer: Rasterizer, model: DeviceModel, camera: DeviceCamera, background: Array, depth: bool = False
) -> Layers:
    """Render a view to the host.  background: [3]; depth: whether to render both depths too, in a second pass."""
    frame = rasterizer.forward(model, camera, background)
    image = crop(frame, frame.image.get())
    alpha = crop(frame, 1 - np.abs(frame.transmittance.get()[None]))[:, :, 0]
    return Layers(image, alpha, *(_depths(rasterizer, model, camera) if depth else (None, None)))


def crop(frame: Frame, planes: Floats) -> Floats:
    """Crop planes, [channels, rows, stride], to the image; return [height, width, channels]."""
    return np.ascontiguousarray(planes[:, : frame.camera.height, : frame.camera.width].transpose(1, 2, 0))


def _depths(rasterizer: Rasterizer, model: DeviceModel, camera: DeviceCamera) -> tuple[Floats, Floats]:
    """Return the mean and the median depth."""
    black = rasterizer.device.upload(np.zeros(3, np.float32))
    frame = rasterizer.forward(model, camera, black, "depth")
    planes = crop(frame, frame.image.get())
    weight = planes[:, :, 1]
    mean_depth = np.divide(planes[:, :, 0], weight, out=np.zeros_like(weight), where=weight > 0)
    return mean_depth, np.ascontiguousarray(planes[:, :, 2])


class Painter(Protocol):
    """A renderer for cameras of any image size."""

    @property
    def workspace(self) -> Workspace:
        """The device memory that is reused between renders."""

    def paint(self, camera: DeviceCamera) -> Array:
        """Return the render, [3, rows, stride], not clamped; valid until the next render."""

    def render_layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        """Return the render on the host, with alpha, and with depth if requested."""


@dataclass(frozen=True)
class SplatPainter:
    """A renderer of Gaussians over a background color, [3] in [0, 1]."""

    rasterizer: Rasterizer
    model: DeviceModel
    background: Array

    @property
    def workspace(self) -> Workspace:
        return self.rasterizer.workspace

    def paint(self, camera: DeviceCamera) -> Array:
        return self.rasterizer.forward(self.model, camera, self.background).image

    def render_layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        return render_layers(self.rasterizer, self.model, camera, self.background, depth)
