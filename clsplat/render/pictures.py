"""What a view shows, on the host: colour, coverage and depth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Frame, Rasterizer

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Layers:
    """A rendered view, layer by layer."""

    image: Floats  # [height, width, 3], background included
    alpha: Floats  # [height, width] in [0, 1], how much of a pixel the model covers
    depth: Floats | None  # [height, width] scene units, mean depth of what covers a pixel; 0 where nothing does

    @property
    def arrays(self) -> list[Floats]:
        """All layers that were rendered."""
        return [self.image, self.alpha, *([] if self.depth is None else [self.depth])]


def layers(
    rasterizer: Rasterizer, model: DeviceModel, camera: DeviceCamera, background: Array, depth: bool = False
) -> Layers:
    """Render a view.  background: [3]; depth takes another pass."""
    frame = rasterizer.forward(model, camera, background)
    image = inside(frame, frame.image.get())
    alpha = inside(frame, 1 - np.abs(frame.transmittance.get()[None]))[:, :, 0]
    return Layers(image, alpha, _depth(rasterizer, model, camera) if depth else None)


def inside(frame: Frame, planes: Floats) -> Floats:
    """[channels, rows, stride] -> [height, width, channels]."""
    return np.ascontiguousarray(planes[:, : frame.camera.height, : frame.camera.width].transpose(1, 2, 0))


def _depth(rasterizer: Rasterizer, model: DeviceModel, camera: DeviceCamera) -> Floats:
    black = rasterizer.device.upload(np.zeros(3, np.float32))
    frame = rasterizer.forward(model, camera, black, "depth")
    planes = inside(frame, frame.image.get())
    weight = planes[:, :, 1]
    return np.divide(planes[:, :, 0], weight, out=np.zeros_like(weight), where=weight > 0)
