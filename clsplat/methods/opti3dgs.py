"""AutoOpti3DGS: a photograph without its finest details, which a filter that is learned lets return."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.core.schedule import NonNegative, at_step
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import ByNumber
from clsplat.photos.transforms import LearnedTransform, Planes

STRIP = int(constants("haar.cl")["STRIP"])
NAMES = {"filter": ("haar/scale", "haar/leak"), "scale": ("haar/scale",)}


class Haar(LearnedTransform):
    """Take the photograph's finest details away, and let them return as a filter is learned (AutoOpti3DGS, Nguyen et
    al. 2025).

    The photograph passes one level of the Haar transform and back.  The high-pass filter of the way there is
    h = s (1, -1) / √2 + l (1, 1) / √2 with scale s and leak l, which are learned and begin at zero: squares of 2 x 2 px
    are their mean.  They follow the losses on images, and one of their own, weight · 2 ((1 - s)² + l²), which pulls h
    to Haar's, where the photograph is as it was.  Pixels that a mask leaves out are the mean of those of their square
    that count.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})

    type: Literal["haar"] = "haar"
    learn: Literal["filter", "scale"] = "filter"
    """Scale and leak, which is every filter of two taps, or the scale alone."""
    rate: NonNegative = 1.0e-4
    """Learning rate of the filter, by Adam; it decides how fast details return; by step."""
    weight: NonNegative = 0.05
    """Factor of the loss that pulls the filter to Haar's; by step."""

    def first(self) -> ByNumber:
        return dict.fromkeys(NAMES[self.learn], 0.0)

    def penalty(self, numbers: ByNumber, step: int) -> tuple[float, ByNumber]:
        weight = at_step(self.weight, step)
        away = {name: value - (name == "haar/scale") for name, value in numbers.items()}
        value = weight * 2 * sum(one**2 for one in away.values())
        return value, {name: 4 * weight * one for name, one in away.items()}

    def apply(self, planes: Planes, step: int) -> Planes:
        camera, workspace = planes.camera, planes.workspace
        found = workspace.array("haar", planes.colours.shape)
        workspace.device.program("haar.cl").haar_forward(
            items=(camera.stride // 2, camera.rows // 2),
            image=planes.colours,
            found=found,
            **self._arguments(planes, found),
        )
        return replace(planes, colours=found, source=planes.colours)

    def backward(self, planes: Planes, gradient: Array) -> Callable[[], ByNumber]:
        columns, strips = planes.camera.stride // 2, -(-planes.camera.rows // (2 * STRIP))
        sums = planes.workspace.array("haar sums", (2, strips, columns))
        planes.workspace.device.program("haar.cl").haar_backward(
            items=(columns, strips),
            image=planes.source,
            gradient=gradient,
            sums=sums,
            **self._arguments(planes, sums),
        )
        copied = sums.get_later()

        def derivatives() -> ByNumber:
            by_u, by_v = (float(part.sum(dtype=np.float64)) for part in copied())
            return dict(zip(self.first(), (by_u - by_v, by_u + by_v), strict=False))

        return derivatives

    def _arguments(self, planes: Planes, unread: Array) -> dict[str, Any]:
        """Arguments of both kernels; `unread` stands in the place of a mask."""
        numbers, masked = self.now(planes.numbers), int(planes.mask is not None)
        scale, leak = numbers["haar/scale"], numbers.get("haar/leak", 0.0)
        sizes = planes.camera.plane_arguments()
        return {"mask": planes.mask or unread, "masked": masked, "u": leak + scale, "v": leak - scale, **sizes}
