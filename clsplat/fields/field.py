"""A field on the device: the parameters of its network, and its pictures."""

import numpy as np
from numpy.typing import NDArray

from clsplat.fields.levels import Levels
from clsplat.fields.shape import FieldShape
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace


class Field:
    """The parameters of a shape; paints views as Gaussians do (clsplat.render.painter)."""

    def __init__(self, shape: FieldShape, parameters: Array, background: Array) -> None:
        """parameters: [P], changed in place by training; background: [3] in [0, 1]."""
        self.shape, self.parameters = shape, parameters
        self.levels = Levels(Workspace(parameters.device), shape, background)

    @classmethod
    def first(cls, shape: FieldShape, seed: int, background: Array) -> "Field":
        """Return a field with the first parameters of a seed."""
        return cls(shape, background.device.upload(shape.first_parameters(seed)), background)

    @property
    def workspace(self) -> Workspace:
        return self.levels.workspace

    def paint(self, camera: DeviceCamera) -> Array:
        """Return the picture of the fine level, [3, rows, stride], zero outside the camera's pixels."""
        image = self.workspace.array("field picture", (3, camera.rows, camera.stride))
        image.fill(0)
        for pixels in self._passes(camera):
            rays = self.levels.cast(camera, self.workspace.device.upload(pixels))
            *_, fine = self.levels.render(self.parameters, rays)
            self.levels.place(fine, image)
        return image

    def _passes(self, camera: DeviceCamera) -> list[NDArray[np.uint32]]:
        pixels, at_a_time = np.arange(camera.width * camera.height, dtype=np.uint32), self.levels.rays_at_a_time
        return [pixels[first : first + at_a_time] for first in range(0, len(pixels), at_a_time)]
