"""Transforms of the photograph before a step compares it: each depends on the photograph and the step."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.schedule import NonNegative, at_step
from clsplat.settings import Settings

REACH = 3  # standard deviations of a blur's window


@dataclass(frozen=True)
class Planes:
    """A photograph as floats on the device, zero outside the image; valid until the next step."""

    workspace: Workspace
    camera: DeviceCamera
    colours: Array  # [3, rows, stride] in [0, 1]
    mask: Array | None  # [1, rows, stride], 1 in pixels that count, else 0; None: all count


class PhotographTransform(Settings):
    """A change of the photograph before it is compared with the rendered image; the file stays unchanged."""

    @abstractmethod
    def apply(self, planes: Planes, step: int) -> Planes:
        """Return the photograph of a global step; it may depend on its arguments only."""


class Blur(PhotographTransform):
    """Blur the photograph by a Gaussian; masked pixels do not count."""

    type: Literal["blur"] = "blur"
    sigma: NonNegative
    """Standard deviation in px of the photograph at its training size; by step."""

    def apply(self, planes: Planes, step: int) -> Planes:
        camera, sigma = planes.camera, at_step(self.sigma, step)
        reach = math.ceil(REACH * sigma)
        if reach == 0:
            return planes
        device, reach = planes.workspace.device, min(reach, max(camera.width, camera.height))
        sums = planes.workspace.array("blur", (4, camera.rows, camera.stride))
        items, size = (camera.width, camera.height), {"reach": reach, **camera.plane_arguments()}
        program, masked = device.program("blur.cl"), planes.mask is not None
        program.blur_rows(
            items=items,
            image=planes.colours,
            mask=planes.mask or sums,
            sums=sums,
            masked=int(masked),
            falloff=0.5 / sigma**2,
            **size,
        )
        program.blur_columns(items=items, sums=sums, image=planes.colours, falloff=0.5 / sigma**2, **size)
        return planes
