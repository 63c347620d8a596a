"""Statistics of each Gaussian over the views since the last edit, in named columns that density rules read.

A column is a table `stats/<name>`: the sum of one number per view, or of several, over the views that see the
Gaussian.  Its mean is the sum divided by the number of those views, or by another column.  Only columns that a rule
reads are summed.
"""

from abc import abstractmethod
from collections.abc import Collection
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.settings import Settings, VariantName, variants
from clsplat.gaussians.gaussians import Gaussians
from clsplat.losses.base import ViewGradients
from clsplat.opencl.device import Array, constants
from clsplat.render.rasterizer import PIXEL_SUMS, Frame

FOLDER = "stats/"
SEEN = "stats/seen"
ABS_X = int(constants("splat.h")["SUM_ABS_X"])
WEIGHT = int(constants("splat.h")["SUM_WEIGHT"])
TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


OF_CONICS = {  # records and sums have others for the pixel's box (cl_kernels/splat.h)
    "box": "it reads the inverse covariance of splats, which a box does not have; choose another screen filter (mip is "
    "the nearest), or another rule"
}


class Statistic(Settings):
    """A column, and how a view adds to it."""

    components: ClassVar[int] = 1  # numbers of each Gaussian; rules that compare a mean with a threshold need 1
    pixel_sums: ClassVar[int] = PIXEL_SUMS  # number of sums over pixels that the backward pass must compute
    divisor: ClassVar[str] = "seen"  # column that divides the sum: views that see the Gaussian, or another column
    of_all_views: ClassVar[bool] = False  # the mean is multiplied by the number of training views

    @abstractmethod
    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        """Add a view to `total`, [components, S].  grad_mean2d: [2, S] px⁻¹."""


class ScreenGrad(Statistic):
    """Length of the gradient by the projected mean, in normalized device coordinates (Kerbl et al. 2023).

    Published thresholds have the same unit.
    """

    type: Literal["screen_grad"] = "screen_grad"

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_norm(
            **_arguments(gaussians, view.frame), planes=grad_mean2d, first=0, total=total
        )


class ScreenGradAbs(Statistic):
    """`screen_grad` from sums of absolute values over pixels, which do not cancel (AbsGS, Ye et al. 2024)."""

    type: Literal["screen_grad_abs"] = "screen_grad_abs"
    pixel_sums = ABS_X + 2

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_norm(
            **_arguments(gaussians, view.frame), planes=view.pixel_sums, first=ABS_X, total=total
        )


class ScreenGradAbsSum(Statistic):
    """The absolute sums of `screen_grad_abs` in x and in y, added (Gaussian Opacity Fields, Yu et al. 2024)."""

    type: Literal["screen_grad_abs_sum"] = "screen_grad_abs_sum"
    pixel_sums = ABS_X + 2

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_sum(
            **_arguments(gaussians, view.frame), planes=view.pixel_sums, first=ABS_X, total=total
        )


class Texture(Statistic):
    """The photograph's gradient magnitude under the splat, per px: Σ α T |∇I| / Σ α T over pixels of all views.

    Both sums leave out masked pixels.
    """

    type: Literal["texture"] = "texture"
    pixel_sums = TEXTURE + 1
    divisor = "blend_weight"

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        _add_pixel_sum(gaussians, view, TEXTURE, total)


class ScreenRadius(Statistic):
    """Radius of the splat, three standard deviations, px."""

    type: Literal["screen_radius"] = "screen_radius"

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_radius(
            items=gaussians.count, radius=view.frame.radius, total=total, count=gaussians.count
        )


class BlendWeight(Statistic):
    """Weight of a splat in the image: α T, summed over pixels whose texture is known."""

    type: Literal["blend_weight"] = "blend_weight"
    pixel_sums = TEXTURE + 1

    def add(self, gaussians: Gaussians, view: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        _add_pixel_sum(gaussians, view, WEIGHT, total)


StatisticName = Annotated[str, VariantName(Statistic, lambda kind: kind.components == 1)]


class SplatStats:
    """The columns of a model, and the number of views that see each Gaussian."""

    def __init__(
        self, gaussians: Gaussians, names: Collection[str] = ("screen_grad",), training_views: int = 1
    ) -> None:
        """Attach the columns `names` and their divisors, drop all others; existing columns keep their sums."""
        self.gaussians, self.training_views = gaussians, training_views
        known = variants(Statistic)
        needed = {*names, *(known[name].divisor for name in names)}
        self.columns = {name: kind() for name, kind in known.items() if name in needed}
        tables = {SEEN: 1} | {FOLDER + name: column.components for name, column in self.columns.items()}
        for name in [name for name in gaussians.tables if name.startswith(FOLDER) and name not in tables]:
            del gaussians.tables[name]
        for name, components in tables.items():
            if name not in gaussians.tables:
                gaussians.add(name, components, zero_fresh=True)

    @property
    def names(self) -> tuple[str, ...]:
        """The columns, in the order in which their classes are defined."""
        return tuple(self.columns)

    @property
    def pixel_sums(self) -> int:
        """Number of sums over pixels that the backward pass must compute for these columns."""
        return max((column.pixel_sums for column in self.columns.values()), default=PIXEL_SUMS)

    def total(self, name: str) -> Array:
        """Return a column's sums over views, [components, S]."""
        return self.gaussians[FOLDER + name]

    def divisor(self, name: str) -> Array:
        """Return the sums that divide a column, [S]."""
        return self.gaussians[FOLDER + self.columns[name].divisor]

    def factor(self, name: str) -> int:
        """Return what a column's sum by its divisor is multiplied by."""
        return self.training_views if self.columns[name].of_all_views else 1

    @property
    def seen(self) -> Array:
        """Number of views that see each Gaussian, [S]."""
        return self.gaussians[SEEN]

    def add(self, view: ViewGradients, grad_mean2d: Array) -> None:
        """Add one view.  grad_mean2d: [2, S] px⁻¹."""
        gaussians = self.gaussians
        gaussians.device.program("density.cl").count_seen(
            items=gaussians.count, radius=view.frame.radius, seen=self.seen, count=gaussians.count
        )
        for name, column in self.columns.items():
            column.add(gaussians, view, grad_mean2d, self.total(name))

    def mean(self, name: str) -> NDArray[np.float32]:
        """Return a column's mean for each Gaussian, on the host, [N]; 0 where the divisor is 0."""
        return self.means(name)[:, 0]

    def means(self, name: str) -> NDArray[np.float32]:
        """Return the means of a column of several components, as `mean` does, [N, components]."""
        total, divisor = (self.gaussians.get(FOLDER + table) for table in (name, self.columns[name].divisor))
        return np.divide(total, divisor, out=np.zeros_like(total), where=divisor > 0) * np.float32(self.factor(name))

    def clear(self) -> None:
        """Set all columns to zero."""
        for name in self.gaussians.tables:
            if name.startswith(FOLDER):
                self.gaussians[name].fill(0)


def _add_pixel_sum(gaussians: Gaussians, view: ViewGradients, pixel_sum: int, total: Array) -> None:
    gaussians.device.program("density.cl").accumulate_pixel_sum(
        items=gaussians.count,
        pixel_sums=view.pixel_sums,
        radius=view.frame.radius,
        total=total,
        pixel_sum=pixel_sum,
        stride=gaussians.capacity,
        count=gaussians.count,
    )


def _arguments(gaussians: Gaussians, frame: Frame) -> dict[str, Any]:
    return {
        "items": gaussians.count,
        "radius": frame.radius,
        "half_width": frame.camera.width / 2,
        "half_height": frame.camera.height / 2,
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }
