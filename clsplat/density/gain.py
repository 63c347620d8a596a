"""What a Gaussian promises to take away of the error, in a unit that all scenes share (ours).

To first order, a shift by one standard deviation on the screen changes the loss by at most sqrt(g^T C g), with the
gradient g by the projected mean and the splat's covariance C: so much may a Gaussian change that is put beside.  The
unit is the error of a mean pixel, of the sum of |dL/dC (C - photograph)| over a view, which is the value of L1 and
twice that of L2.  A threshold then says how many pixels' errors, over all training views, make up for the 59 numbers
of a Gaussian.
"""

from typing import ClassVar, Literal

from clsplat.density.statistics import Statistic
from clsplat.gaussians.tables import Gaussians
from clsplat.losses.base import ViewGradients
from clsplat.losses.image import view_error
from clsplat.opencl.device import Array


class Gain(Statistic):
    """How many pixels' errors a Gaussian promises to take away: those of mean pixels, over all training views (ours).

    It is what the loss changes by a shift of one standard deviation on the screen, whatever the photographs' exposure,
    size and number and the losses' weights.
    """

    type: Literal["gain"] = "gain"
    divisor: ClassVar[str] = "view_error"
    reads_conics: ClassVar[bool] = True
    of_all_views: ClassVar[bool] = True

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_gain(
            items=gaussians.count,
            grad_mean2d=grad_mean2d,
            splats=view.frame.splats,
            radius=view.frame.radius,
            total=total,
            factor=float(view.frame.camera.width * view.frame.camera.height),
            stride=gaussians.capacity,
            count=gaussians.count,
        )


class ViewError(Statistic):
    """The error of the views in the losses' own measure, of those that do not see the Gaussian too."""

    type: Literal["view_error"] = "view_error"

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_error(
            items=gaussians.count, error=view_error(view.comparison), total=total, count=gaussians.count
        )
