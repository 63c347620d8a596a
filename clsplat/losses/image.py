"""Define the photometric losses L1, L2, and D-SSIM."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.core.errors import DataError
from clsplat.core.schedule import at_step
from clsplat.losses.base import Comparison, ImageLoss, LossValue, require_loss_value
from clsplat.opencl.device import Array, constants

SSIM_BLOCKS = {  # columns and rows of a group
    schedule: tuple(int(constants("ssim.cl")[f"{schedule.upper()}_{name}"]) for name in ("COLUMNS", "ROWS"))
    for schedule in ("wide", "simt")
}
SSIM_PIXELS_MAX = 2**32 // 9  # the kernels index nine planes in 32 bits


class L1(ImageLoss):
    """Mean absolute difference of all values."""

    symmetric: ClassVar[bool] = True

    type: Literal["l1"] = "l1"

    def add(self, comparison: Comparison) -> LossValue:
        weight = at_step(self.weight, comparison.step)
        sums = pixel_loss(comparison, l1=weight, l2=0.0)
        return LossValue("l1", lambda: weight * float(sums.get()[..., 0].sum(dtype=np.float64)) / comparison.size)


class L2(ImageLoss):
    """Mean squared difference of all values."""

    symmetric: ClassVar[bool] = True

    type: Literal["l2"] = "l2"

    def add(self, comparison: Comparison) -> LossValue:
        weight = at_step(self.weight, comparison.step)
        sums = pixel_loss(comparison, l1=0.0, l2=weight)
        return LossValue("l2", lambda: weight * float(sums.get()[..., 1].sum(dtype=np.float64)) / comparison.size)


class Dssim(ImageLoss):
    """1 - SSIM (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels."""

    symmetric: ClassVar[bool] = True

    type: Literal["dssim"] = "dssim"

    def add(self, comparison: Comparison) -> LossValue:
        return self.add_with(comparison, None)[0]

    def add_with(self, comparison: Comparison, l1: L1 | None) -> list[LossValue]:
        """Add the gradients of this loss and of an L1 before it in one pass over the image; return their values."""
        weight, size = at_step(self.weight, comparison.step), comparison.size
        l1_weight = at_step(l1.weight, comparison.step) if l1 else 0.0
        factors = {"scale": -weight / size, "l1": l1_weight / size, "has_l1": int(l1 is not None)}
        arguments, key = {**comparison.arguments(), **factors}, ("dssim", comparison.camera.size)
        sums, absolute = comparison.workspace.plans.run(key, arguments, add_ssim_gradient, comparison, arguments)
        comparison.accumulate = True
        value = LossValue("dssim", lambda: weight * (1.0 - float(sums.get().sum(dtype=np.float64)) / size))
        l1_value = LossValue("l1", lambda: l1_weight * float(absolute.get().sum(dtype=np.float64)) / size)
        return [l1_value, value] if l1 else [value]


def add_losses(losses: Sequence[ImageLoss], comparison: Comparison) -> list[LossValue]:
    """Add the gradients of losses, in this order; return their values.  One kernel adds an SSIM and an L1 before it."""
    values, remaining = list[LossValue](), list(losses)
    while remaining:
        loss, following = remaining.pop(0), remaining[0] if remaining else None
        if type(loss) is L1 and type(following) is Dssim:
            values += following.add_with(comparison, loss)
            del remaining[0]
        else:
            values.append(require_loss_value(loss, loss.add(comparison)))
    return values


def pixel_loss(comparison: Comparison, l1: float, l2: float) -> Array:
    """Add the gradient of weighted L1 and L2; return the sums of |x - y| and (x - y)² by row, [3, rows, 2]."""
    size, key = comparison.size, ("pixel loss", comparison.camera.size)
    arguments = {**comparison.arguments(), "l1": l1 / size, "l2": l2 / size}
    sums = comparison.workspace.plans.run(key, arguments, _pixel_loss, comparison, arguments)
    comparison.accumulate = True
    return sums


def _pixel_loss(comparison: Comparison, arguments: dict[str, Any]) -> Array:
    camera = comparison.camera
    sums = comparison.workspace.array("row_sums", (3, camera.rows, 2))  # identical for all losses of a step
    comparison.workspace.device.program("loss.cl").pixel_loss(
        groups=(1, camera.rows, 3), row_sums=sums, **arguments, **camera.plane_arguments()
    )
    return sums


def psnr(comparison: Comparison) -> float:
    """Return the PSNR of unmasked pixels in dB, without rounding them to 8 bits; waits for the device."""
    squares = pixel_loss(comparison, l1=0.0, l2=0.0).get()[..., 1]
    error = float(squares.sum(dtype="float64")) / comparison.unmasked_size
    return -10 * math.log10(max(error, 1e-10))


def view_error(comparison: Comparison) -> Array:
    """Return the sum over pixels of |gradient * (x - y)|, [1]: the image error, weighted like the losses."""
    camera, workspace = comparison.camera, comparison.workspace
    rows, error = workspace.array("row_errors", (3, camera.rows)), workspace.array("view_error", 1)
    program = workspace.device.program("loss.cl")
    program.view_error(
        groups=(1, camera.rows, 3),
        image=comparison.image,
        photograph=comparison.photograph,
        gradient=comparison.gradient,
        row_errors=rows,
        **camera.plane_arguments(),
    )
    program.sum_errors(groups=(1,), row_errors=rows, error=error, count=3 * camera.rows)
    return error


def add_ssim_gradient(comparison: Comparison, arguments: dict[str, Any]) -> tuple[Array, Array]:
    """Add the gradients of the SSIM, times the argument `scale`, and of the L1, times `l1` if `has_l1`.

    Returns the sums of `ssim_maps`, and those of |x - y|, [3, blocks], if `has_l1`.
    """
    maps, sums = ssim_maps(comparison)
    blocks = _ssim_blocks(comparison, comparison.camera.rows)
    absolute = comparison.workspace.array("l1_sums", (3, math.prod(blocks)))
    comparison.workspace.device.program("ssim.cl").ssim_gradient(
        groups=(*blocks, 3),
        maps=maps,
        absolute_sums=absolute,
        **arguments,
        **comparison.camera.plane_arguments(),
    )
    return sums, absolute


def ssim_maps(comparison: Comparison) -> tuple[Array, Array]:
    """Return the derivatives of the SSIM map, [3, 3, rows, stride], and the map's sums, [3, blocks].

    Raises DataError for images of more than SSIM_PIXELS_MAX pixels, rounded up to full tiles.
    """
    camera, array = comparison.camera, comparison.workspace.array
    if camera.rows * camera.stride > SSIM_PIXELS_MAX:
        raise DataError(
            f"an image of {camera.width}x{camera.height} pixels is too large for SSIM (at most {SSIM_PIXELS_MAX:,}); "
            "downscale it"
        )
    blocks = _ssim_blocks(comparison, camera.height)
    maps = array("ssim_maps", (3, 3, camera.rows, camera.stride))
    sums = array("ssim_sums", (3, math.prod(blocks)))
    comparison.workspace.device.program("ssim.cl").ssim_maps(
        groups=(*blocks, 3),
        image=comparison.image,
        photograph=comparison.photograph,
        maps=maps,
        block_sums=sums,
        **comparison.camera.plane_arguments(),
    )
    return maps, sums


def _ssim_blocks(comparison: Comparison, rows: int) -> tuple[int, int]:
    """Return the number of blocks of the SSIM kernels across the planes, and down to a row."""
    columns_per_block, rows_per_block = SSIM_BLOCKS[
        "wide" if comparison.workspace.device.schedule == "wide" else "simt"
    ]
    return -(-comparison.camera.stride // columns_per_block), -(-rows // rows_per_block)
