"""Transform the photograph of a training step before it is compared with the render."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

from clsplat.core.schedule import NonNegative, at_step
from clsplat.core.settings import Settings
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace

REACH = 3  # radius of the window of a blur, in standard deviations


@dataclass(frozen=True)
class Planes:
    """A photograph as floats on the device, zero outside the image; valid until the next step."""

    workspace: Workspace
    camera: DeviceCamera
    colors: Array  # [3, rows, stride] in [0, 1]
    mask: Array | None  # [1, rows, stride], 1 in pixels that count, else 0; None if all count


class PhotographTransform(Settings):
    """A transform of the photograph before it is compared with the render."""

    @abstractmethod
    def apply(self, planes: Planes, step: int) -> Planes:
        """Return the photograph, transformed for a global step.  The result must depend only on the arguments."""


class Blur(PhotographTransform):
    """Blur the photograph with a Gaussian; masked pixels do not count."""

    type: Literal["blur"] = "blur"
    sigma: NonNegative
    """Standard deviation, px at training size; may be scheduled."""

    def apply(self, planes: Planes, step: int) -> Planes:
        sigma = at_step(self.sigma, step)
        return planes if sigma == 0 else _average(planes, math.ceil(REACH * sigma), 0.5 / sigma**2)


class MeanFilter(PhotographTransform):
    """Replace each pixel with the mean of the unmasked pixels in a square around it (Opti3DGS, Farooq et al. 2025)."""

    type: Literal["mean_filter"] = "mean_filter"
    width: NonNegative
    """Side of the square as a fraction of the photo's width, rounded to an odd number of px; may be scheduled."""

    def apply(self, planes: Planes, step: int) -> Planes:
        return _average(planes, math.floor(at_step(self.width, step) * planes.camera.width / 2), 0.0)


def _average(planes: Planes, reach: int, falloff: float) -> Planes:
    """Average the pixels within `reach` px in x and y, weighted by exp(-falloff distance²).  falloff: in px⁻²."""
    if reach == 0:
        return planes
    camera, device = planes.camera, planes.workspace.device
    reach = min(reach, max(camera.width, camera.height))
    sums = planes.workspace.array("blur", (4, camera.rows, camera.stride))
    items, size = (camera.width, camera.height), {"reach": reach, **camera.plane_arguments()}
    program, mask = device.program("blur.cl"), planes.mask
    program.blur_rows(
        items=items,
        image=planes.colors,
        mask=mask or sums,
        sums=sums,
        masked=int(mask is not None),
        falloff=falloff,
        **size,
    )
    program.blur_columns(items=items, sums=sums, image=planes.colors, falloff=falloff, **size)
    return planes
