"""Depths that are known: what a pixel's splats show of them, against what structure from motion has found."""

from typing import ClassVar, Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import at_step
from clsplat.core.settings import InputPath
from clsplat.losses.base import Comparison, ImageLoss, LossValue
from clsplat.render.rasterizer import Content


class InverseDepth(ImageLoss):
    """Mean over a photograph's points of q |D - 1/z|, times the scene's extent: D = Σ w / z is the blended inverse
    depth of the pixel that a point falls on, z the point's depth.

    q is 1 for points that four photographs show, and less for others.  It is 0 in a photograph that shows the point a
    pixel or more from where its camera does, at the size of training, where the dataset tells that.  D counts nothing
    behind the splats, so that they also become opaque where a point is.  A weight of 0.02 that falls to 0 over the
    first half of the steps is ours.  It needs points with tracks, as those of COLMAP; no poses are learned with it.
    """

    type: Literal["inverse_depth"] = "inverse_depth"
    folder: InputPath | None = None
    """Folder of depth maps, one for each photograph: `a.png` for a.jpg, 8 or 16 bits, bright is near, linear in 1/z.
    Each is fitted to the points of its photograph, and compared with in their place; without it, the points alone."""
    reads_photograph: ClassVar[bool] = False

    def reads(self, step: int) -> Content:
        return "inverse_depth" if at_step(self.weight, step) > 0 else "color"

    def add(self, comparison: Comparison) -> LossValue:
        weight, known, camera = at_step(self.weight, comparison.step), comparison.depths, comparison.camera
        if weight == 0 or known is None:
            return LossValue("inverse_depth", lambda: 0.0)
        if len(comparison.image.shape) != 3 or comparison.image.shape[0] < 4:
            raise ConfigError(
                "the loss inverse_depth needs a frame whose content is 'inverse_depth'; the trainer makes one"
            )
        count = known.pixels.shape[0]
        scale = weight * known.extent / count
        terms = comparison.workspace.array("inverse_depth_terms", count)
        comparison.workspace.device.program("inverse_depth.cl").inverse_depth_loss(
            items=count,
            image=comparison.image,
            gradient=comparison.gradient,
            pixels=known.pixels,
            targets=known.inverse,
            weights=known.weights,
            terms=terms,
            scale=scale,
            plane=camera.rows * camera.stride,
            count=count,
        )
        return LossValue("inverse_depth", lambda: scale * float(np.asarray(terms.get()).sum(dtype=np.float64)))
