"""Supervise depths with points of structure from motion, or with depth maps."""

from typing import ClassVar, Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import at_step
from clsplat.core.settings import InputPath
from clsplat.losses.base import Comparison, ImageLoss, LossValue
from clsplat.render.rasterizer import Content


class InverseDepth(ImageLoss):
    """Mean over a photograph's points of q |D - 1/z|, times the scene's extent, with z the depth of a point, and
    D the blended inverse depth of its pixel: the sum of weight / depth over splats.

    q is 1 for points in at least four photographs, less for others, and 0 in photographs with a reprojection error of a
    pixel or more at training size, if the dataset has such errors.  The background does not add to D, so splats also
    become opaque at points.  We use a weight of 0.02 that falls to 0 over the first half of the steps.  The loss needs
    points with tracks, as in COLMAP models.  It has no effect on the optimization of poses.
    """

    type: Literal["inverse_depth"] = "inverse_depth"
    folder: InputPath | None = None
    """Folder of depth maps, one per photo: `a.png` for a.jpg, 8 or 16 bits, linear in 1/z, bright is near.  Each
    map is fitted to the points of its photo, and used instead of them.  Default: only points."""
    reads_photograph: ClassVar[bool] = False

    def required_content(self, step: int) -> Content:
        return "inverse_depth" if at_step(self.weight, step) > 0 else "color"

    def add(self, comparison: Comparison) -> LossValue:
        weight, depths, camera = at_step(self.weight, comparison.step), comparison.depths, comparison.camera
        if weight == 0 or depths is None:
            return LossValue("inverse_depth", lambda: 0.0)
        if len(comparison.image.shape) != 3 or comparison.image.shape[0] < 4:
            raise ConfigError("the loss inverse_depth needs a frame that was rendered with the content 'inverse_depth'")
        count = depths.pixels.shape[0]
        scale = weight * depths.extent / count
        terms = comparison.workspace.array("inverse_depth_terms", count)
        comparison.workspace.device.program("inverse_depth.cl").inverse_depth_loss(
            items=count,
            image=comparison.image,
            gradient=comparison.gradient,
            pixels=depths.pixels,
            targets=depths.inverse,
            weights=depths.weights,
            terms=terms,
            scale=scale,
            plane=camera.rows * camera.stride,
            count=count,
        )
        return LossValue("inverse_depth", lambda: scale * float(np.asarray(terms.get()).sum(dtype=np.float64)))
