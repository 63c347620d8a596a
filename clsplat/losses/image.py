"""Photometric losses: each adds its share to the image's gradient, and can tell its value when somebody asks."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.rasterizer import DeviceCamera, Frame
from clsplat.render.workspace import Workspace
from clsplat.schedule import Weight, at_step
from clsplat.settings import Settings

SSIM_BLOCK = int(constants("loss.cl")["BLOCK"])


@dataclass
class Comparison:
    """A rendered image beside its photograph, float planes [3, rows, stride], and the gradient that losses add to.

    The photograph may have a fourth plane, its mask; losses are means over the whole image, so that a threshold means
    the same with and without one.
    """

    workspace: Workspace
    camera: DeviceCamera
    image: Array
    target: Array
    gradient: Array
    step: int = 0  # that weights are taken at
    accumulate: bool = False  # False: the next loss overwrites the gradient

    @property
    def values(self) -> int:
        """Number of values in the image."""
        return 3 * self.camera.width * self.camera.height

    @property
    def counted(self) -> int:
        """Number of values in pixels that count; waits for the device where there is a mask."""
        return 3 * int(self.target.get()[3].sum()) if self.target.shape[0] == 4 else self.values


@dataclass(frozen=True)
class LossValue:
    """A loss of one step.  Reading its value waits for the device."""

    name: str
    value: Callable[[], float]  # weight included


@dataclass(frozen=True)
class ViewGradients:
    """A view's frame, its losses and what their gradients are made of; valid until the next one."""

    frame: Frame
    comparison: Comparison
    terms: list[LossValue]
    pixel_sums: Array  # [count, S]


class Loss(Settings):
    """A term of the training loss."""

    weight: Weight = 1.0  # a number, or [[step, weight], ...] with straight lines between

    @abstractmethod
    def add(self, comparison: Comparison) -> LossValue:
        """Add weight · d(loss)/d(image) to the gradient."""


class L1(Loss):
    """Mean absolute difference of all values."""

    type: Literal["l1"] = "l1"

    def add(self, comparison: Comparison) -> LossValue:
        weight = at_step(self.weight, comparison.step)
        sums = pixel_loss(comparison, l1=weight, l2=0.0)
        return LossValue("l1", lambda: weight * float(sums.get()[..., 0].sum(dtype=np.float64)) / comparison.values)


class L2(Loss):
    """Mean squared difference of all values."""

    type: Literal["l2"] = "l2"

    def add(self, comparison: Comparison) -> LossValue:
        weight = at_step(self.weight, comparison.step)
        sums = pixel_loss(comparison, l1=0.0, l2=weight)
        return LossValue("l2", lambda: weight * float(sums.get()[..., 1].sum(dtype=np.float64)) / comparison.values)


class Dssim(Loss):
    """1 - SSIM (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels."""

    type: Literal["dssim"] = "dssim"

    def add(self, comparison: Comparison) -> LossValue:
        weight = at_step(self.weight, comparison.step)
        maps, sums = ssim_maps(comparison)
        comparison.workspace.device.program("loss.cl").ssim_gradient(
            groups=(-(-comparison.camera.stride // SSIM_BLOCK), comparison.camera.rows, 3),
            maps=maps,
            image=comparison.image,
            target=comparison.target,
            gradient=comparison.gradient,
            scale=-weight / comparison.values,
            accumulate=int(comparison.accumulate),
            **comparison.camera.plane_arguments(),
        )
        comparison.accumulate = True
        return LossValue("dssim", lambda: weight * (1.0 - float(sums.get().sum(dtype=np.float64)) / comparison.values))


LOSSES: dict[str, type[Loss]] = {"l1": L1, "l2": L2, "dssim": Dssim}


def pixel_loss(comparison: Comparison, l1: float, l2: float) -> Array:
    """Add the gradient of weighted L1 and L2; return the sums of |x - y| and (x - y)² by row, [3, rows, 2]."""
    camera, values = comparison.camera, comparison.values
    sums = comparison.workspace.array("row_sums", (3, camera.rows, 2))  # the same for all terms of a step
    comparison.workspace.device.program("loss.cl").pixel_loss(
        groups=(1, camera.rows, 3),
        image=comparison.image,
        target=comparison.target,
        gradient=comparison.gradient,
        row_sums=sums,
        l1=l1 / values,
        l2=l2 / values,
        accumulate=int(comparison.accumulate),
        **comparison.camera.plane_arguments(),
    )
    comparison.accumulate = True
    return sums


def ssim_maps(comparison: Comparison) -> tuple[Array, Array]:
    """Return the derivatives of the SSIM map [3, 3, rows, stride] and the map's sums [3, height, blocks]."""
    camera, array = comparison.camera, comparison.workspace.array
    blocks = -(-camera.stride // SSIM_BLOCK)
    maps = array("ssim_maps", (3, 3, camera.rows, camera.stride))
    sums = array("ssim_sums", (3, camera.height, blocks))
    comparison.workspace.device.program("loss.cl").ssim_maps(
        groups=(blocks, camera.height, 3),
        image=comparison.image,
        target=comparison.target,
        maps=maps,
        block_sums=sums,
        **comparison.camera.plane_arguments(),
    )
    return maps, sums
