"""What each Gaussian contributes to the pictures: its blend weights, alpha T, summed over pixels and views.

The score by which Gaussians are pruned after training (the global significance of LightGaussian, Fan et al. 2024,
without its factors).
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.density.statistics import TEXTURE, WEIGHT
from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Rasterizer
from clsplat.views.photographs import Mask, Photograph


def contributions(rasterizer: Rasterizer, model: DeviceModel, photographs: Iterable[Photograph]) -> NDArray[np.float32]:
    """Return the sum of blend weights over the pixels of photographs, [N]; 0 where a Gaussian is seen nowhere.

    Pixels that a mask leaves out do not count, nor do those beyond the image's edge in its last tiles.  The sums are
    those of the backward pass, in a fixed order: the same bits on the same device.
    """
    device, gaussians = rasterizer.device, model.gaussians
    total, planes, background = device.zeros(gaussians.capacity), Planes(rasterizer), device.zeros(3)
    for photograph in photographs:
        frame = rasterizer.forward(model, photograph.camera, background)
        gradient, counted = planes.of(photograph.camera, photograph.counted())
        pixel_sums = rasterizer.pixel_sums(model, frame, gradient, TEXTURE + 1, counted)
        device.program("density.cl").accumulate_pixel_sum(
            items=gaussians.count,
            pixel_sums=pixel_sums,
            radius=frame.radius,
            total=total,
            pixel_sum=WEIGHT,
            stride=gaussians.capacity,
            count=gaussians.count,
        )
    return np.asarray(total.get()[: gaussians.count])


class Planes:
    """Inputs of a backward pass that only sums weights; views of one size share them."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._device = rasterizer.device
        self._sizes: dict[tuple[int, int], tuple[Array, Array]] = {}

    def of(self, camera: DeviceCamera, mask: Mask | None) -> tuple[Array, Array]:
        """Return a gradient of zeros, [3, rows, stride], and a texture, [rows, stride]: -1 where no pixel counts."""
        size = camera.width, camera.height
        if size not in self._sizes:
            zeros = self._device.zeros((3, camera.rows, camera.stride))
            self._sizes[size] = zeros, self._device.upload(_counted(camera, None))
        gradient, counted = self._sizes[size]
        return gradient, counted if mask is None else self._device.upload(_counted(camera, mask))


def _counted(camera: DeviceCamera, mask: Mask | None) -> NDArray[np.float32]:
    """A texture that is known, 0, in the pixels that count, [rows, stride]."""
    plane = np.full((camera.rows, camera.stride), -1, np.float32)
    inside = np.ones((camera.height, camera.width), bool) if mask is None else mask
    plane[: camera.height, : camera.width][inside] = 0
    return plane
