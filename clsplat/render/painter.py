"""What renders views, whatever it is that a run trains."""

from dataclasses import dataclass
from typing import Protocol

from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.pictures import Layers, layers
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace


class Painter(Protocol):
    """Renders the view of a camera, at whatever size that has."""

    @property
    def workspace(self) -> Workspace:
        """Device memory that pictures reuse."""

    def paint(self, camera: DeviceCamera) -> Array:
        """Return the picture, [3, rows, stride], not clamped; it is valid until the next."""

    def layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        """Return the picture on the host, with coverage, and with depth where that is asked for."""


@dataclass(frozen=True)
class Splats:
    """Paints Gaussians before a background, [3] in [0, 1]."""

    rasterizer: Rasterizer
    model: DeviceModel
    background: Array

    @property
    def workspace(self) -> Workspace:
        return self.rasterizer.workspace

    def paint(self, camera: DeviceCamera) -> Array:
        return self.rasterizer.forward(self.model, camera, self.background).image

    def layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        return layers(self.rasterizer, self.model, camera, self.background, depth)
