"""Blur the photos less and less: `views: {transforms: [{type: box_blur, reach: [[0, 4], [500, 0]]}]}`."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from clsplat.plugin import NonNegative, PhotographTransform, Planes, at_step


class BoxBlur(PhotographTransform):
    """Replace each pixel with the mean of the window around it."""

    type: Literal["box_blur"] = "box_blur"
    reach: NonNegative
    """Pixels on each side of the center of the window, rounded; may be scheduled."""

    def apply(self, planes: Planes, step: int) -> Planes:
        camera, reach = planes.camera, round(at_step(self.reach, step))
        if reach == 0:
            return planes
        blurred = planes.workspace.array("box_blur", planes.colors.shape)
        program = planes.workspace.device.program(Path(__file__).with_suffix(".cl"))
        program.box_blur(
            items=(camera.stride, camera.rows, 3),
            image=planes.colors,
            blurred=blurred,
            reach=reach,
            **camera.plane_arguments(),
        )
        return replace(planes, colors=blurred)
