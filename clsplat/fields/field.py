"""A field on the device: the parameters of its network, and its pictures."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.fields.levels import Level, Levels
from clsplat.fields.shape import FieldShape
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.pictures import Layers
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
        image = self._empty(camera)
        for _, fine in self._passes(camera):
            self.levels.place(fine, image)
        return image

    def layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        """Return the picture of the fine level on the host, what its samples cover, and their mean depth.

        A ray has depth 1 in the camera where its distance is 1, so that distances are depths, in scene units.
        """
        image, size = self._empty(camera), (camera.height, camera.width)
        alpha, depths = (np.zeros(camera.height * camera.width, np.float32) for _ in range(2))
        for pixels, fine in self._passes(camera):
            self.levels.place(fine, image)
            weights, edges = (array.get()[: len(pixels)].astype(np.float64) for array in (fine.weights, fine.edges))
            covered, summed = weights.sum(axis=1), (weights * (edges[:, :-1] + edges[:, 1:]) / 2).sum(axis=1)
            alpha[pixels] = np.minimum(covered, 1)  # a sum of rounded weights
            depths[pixels] = np.divide(summed, covered, out=np.zeros_like(covered), where=covered > 0)
        shown = np.ascontiguousarray(image.get()[:, : camera.height, : camera.width].transpose(1, 2, 0))
        return Layers(shown, alpha.reshape(size), depths.reshape(size) if depth else None)

    def _empty(self, camera: DeviceCamera) -> Array:
        image = self.workspace.array("field picture", (3, camera.rows, camera.stride))
        image.fill(0)
        return image

    def _passes(self, camera: DeviceCamera) -> Iterator[tuple[NDArray[np.uint32], Level]]:
        """Pixels, [n] of row * width + column, and their fine level, valid until the next."""
        pixels, at_a_time = np.arange(camera.width * camera.height, dtype=np.uint32), self.levels.rays_at_a_time
        for first in range(0, len(pixels), at_a_time):
            own = pixels[first : first + at_a_time]
            rays = self.levels.cast(camera, self.workspace.device.upload(own))
            *_, fine = self.levels.render(self.parameters, rays)
            yield own, fine
