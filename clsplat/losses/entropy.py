"""The entropy of blend weights: a pressure on pixels to be made of few Gaussians."""

from typing import ClassVar, Literal

import numpy as np

from clsplat.errors import ConfigError
from clsplat.losses.base import Comparison, ImageLoss, LossValue
from clsplat.render.rasterizer import Content
from clsplat.schedule import at_step


class WeightEntropy(ImageLoss):
    """Mean over pixels of -Σ w ln w - T ln T, w = alpha T the weights of a pixel's splats and T what they leave.

    It makes lists of splats shorter (Liu and Han 2026, with the weight 0.015), and opacities sharper.  Pixels that a
    mask leaves out do not count.
    """

    type: Literal["weight_entropy"] = "weight_entropy"
    reads_photograph: ClassVar[bool] = False

    def reads(self, step: int) -> Content:
        return "entropy"

    def add(self, comparison: Comparison) -> LossValue:
        camera, weight = comparison.camera, at_step(self.weight, comparison.step)
        if len(comparison.image.shape) != 3 or comparison.image.shape[0] < 4:
            raise ConfigError("the loss weight_entropy needs a frame whose content is 'entropy'; the trainer makes one")
        scale = weight / (camera.width * camera.height)
        sums = comparison.workspace.array("entropy_sums", camera.rows)
        comparison.workspace.device.program("loss.cl").weight_entropy(
            groups=(1, camera.rows),
            image=comparison.image,
            gradient=comparison.gradient,
            row_sums=sums,
            scale=scale,
            **camera.plane_arguments(),
        )
        return LossValue("weight_entropy", lambda: scale * float(np.asarray(sums.get()).sum(dtype=np.float64)))
