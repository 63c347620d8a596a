"""Wrap a NumPy function as a loss, for experiments."""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, ValidationError

from clsplat.core.errors import ConfigError, NumericError, quote
from clsplat.core.schedule import NonNegative, Schedule, at_step
from clsplat.losses.base import Comparison, ImageLoss, LossValue

HostFunction = Callable[[NDArray[np.float32], NDArray[np.float32]], tuple[float, NDArray[np.floating]]]


class HostLoss(ImageLoss):
    """A loss in NumPy: `function(image, photograph)` returns its value and its gradient with respect to the image.

    Arrays are [height, width, 3] float32.  Each step copies both images to the host and the gradient back.
    """

    runs_on_host: ClassVar[bool] = True

    weight: NonNegative = 1.0
    _function: HostFunction = PrivateAttr()

    def __init__(self, function: HostFunction, weight: Schedule = 1.0) -> None:
        """Wrap a function.  Raises ConfigError if the weight is not a schedule of nonnegative numbers."""
        try:
            super().__init__(weight=weight.item() if isinstance(weight, np.generic) else weight)
        except ValidationError as error:
            reason = error.errors()[0]["msg"].removeprefix("Value error, ")
            raise ConfigError(f"the weight of the loss is {quote(weight)}; {reason}") from None
        self._function = function

    @property
    def name(self) -> str:
        """The name of the function."""
        return str(getattr(self._function, "__name__", "host"))

    def add(self, comparison: Comparison) -> LossValue:
        camera, weight = comparison.camera, at_step(self.weight, comparison.step)
        height, width = camera.height, camera.width
        image, photograph = (
            np.ascontiguousarray(planes.get()[:3, :height, :width].transpose(1, 2, 0))
            for planes in (comparison.image, comparison.photograph)
        )
        value, derivative = self._call(image, photograph)
        if not (math.isfinite(value) and np.isfinite(derivative).all()):
            raise NumericError(
                f"step {comparison.step}: the loss '{self.name}' returned values that are not finite; "
                "look for a division by 0, or a root or logarithm of 0"
            )
        planes = comparison.gradient.get() if comparison.accumulate else np.zeros(comparison.gradient.shape, np.float32)
        planes[:3, :height, :width] += np.float32(weight) * derivative.transpose(2, 0, 1)
        comparison.gradient.set(planes)
        comparison.accumulate = True
        return LossValue(self.name, lambda: weight * value)

    def _call(self, image: NDArray[np.float32], photograph: NDArray[np.float32]) -> tuple[float, NDArray[np.float32]]:
        """Call the function; return its value and gradient.  Raises ValueError if the result is invalid."""
        result: Any = self._function(image, photograph)
        try:
            value, derivative = result
            value, derivative = float(value), np.asarray(derivative, np.float32)
        except (TypeError, ValueError):
            raise ValueError(
                f"the loss '{self.name}' returned {quote(result)}; expected (value, gradient with respect to the image)"
            ) from None
        if derivative.shape != image.shape:
            raise ValueError(
                f"the loss returned a gradient of shape {derivative.shape}; expected that of the image, {image.shape}"
            )
        return value, derivative
