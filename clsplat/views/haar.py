"""AutoOpti3DGS: a photograph without its finest details, which a filter that is learned lets return."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.schedule import NonNegative, at_step
from clsplat.views.learned import ByNumber, LearnedTransform
from clsplat.views.transforms import Planes

STRIP = int(constants("haar.cl")["STRIP"])
ROOT2 = math.sqrt(2.0)
HAAR = (1 / ROOT2, -1 / ROOT2)  # the filter that changes nothing
NAMES = {"filter": ("haar/h0", "haar/h1"), "scale": ("haar/scale",)}


class Haar(LearnedTransform):
    """Take the photograph's finest details away, and let them return as a filter is learned (AutoOpti3DGS, Nguyen et
    al. 2025).

    The photograph passes one level of the Haar transform and back.  The high-pass filter h of the way there begins at
    zero, where squares of 2 x 2 px are their mean.  It follows the losses on images, and a loss of its own,
    weight · 2 |h - h*|², which pulls it to Haar's h* = (1, -1) / √2, where the photograph is as it was.  Pixels that a
    mask leaves out are the mean of those of their square that count.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})

    type: Literal["haar"] = "haar"
    learn: Literal["filter", "scale"] = "filter"
    """Both taps of the filter, or one scale of Haar's."""
    rate: NonNegative = 1.0e-4
    """Learning rate of the filter, by Adam; it decides how fast details return; by step."""
    weight: NonNegative = 0.05
    """Factor of the loss that pulls the filter to Haar's; by step."""

    def first(self) -> ByNumber:
        return dict.fromkeys(NAMES[self.learn], 0.0)

    def penalty(self, numbers: ByNumber, step: int) -> tuple[float, ByNumber]:
        weight = at_step(self.weight, step)
        away = [found - haar for found, haar in zip(self._filter(numbers), HAAR, strict=True)]
        value = weight * 2 * sum(one**2 for one in away)
        return value, self._by_number([4 * weight * one for one in away])

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
            return self._by_number([ROOT2 * by_u, ROOT2 * by_v])

        return derivatives

    def _filter(self, numbers: ByNumber) -> list[float]:
        """The filter, h0 and h1."""
        values = list(numbers.values())
        return values if self.learn == "filter" else [values[0] * haar for haar in HAAR]

    def _by_number(self, by_filter: list[float]) -> ByNumber:
        """Derivatives by the numbers that are learned, from those by h0 and h1."""
        if self.learn == "scale":
            by_filter = [sum(one * haar for one, haar in zip(by_filter, HAAR, strict=True))]
        return dict(zip(NAMES[self.learn], by_filter, strict=True))

    def _arguments(self, planes: Planes, unread: Array) -> dict[str, Any]:
        """Arguments of both kernels; `unread` stands in the place of a mask."""
        u, v = (ROOT2 * tap for tap in self._filter(self.now(planes.numbers)))
        masked = int(planes.mask is not None)
        return {"mask": planes.mask or unread, "masked": masked, "u": u, "v": v, **planes.camera.plane_arguments()}
