"""Accumulate statistics of each Gaussian over the views since the last edit, for density rules.

A statistic is a table `stats/<name>` with one or more values for each Gaussian, summed over the views in which the
Gaussian is visible.  Its mean is the sum divided by the number of these views, or by another statistic.  Only
statistics that a rule reads are accumulated.
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
from clsplat.opencl.plan import Plans
from clsplat.render.rasterizer import PIXEL_SUMS, Frame

PREFIX = "stats/"
SEEN = "stats/seen"
ABS_X = int(constants("splat.h")["SUM_ABS_X"])
WEIGHT = int(constants("splat.h")["SUM_WEIGHT"])
TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


NEEDS_CONIC = {  # with the box filter, splats and sums have other values (cl_kernels/splat.h)
    "box": "it reads the inverse covariance of splats, which the box filter does not compute; choose another screen "
    "filter (mip is the most similar), or another rule"
}


class Statistic(Settings):
    """A sum over views for each Gaussian."""

    components: ClassVar[int] = 1  # values per Gaussian; rules that compare a mean with a threshold need 1
    pixel_sums: ClassVar[int] = PIXEL_SUMS  # number of sums over pixels that the backward pass must compute
    divisor: ClassVar[str] = "seen"  # name of the table that divides the sum: the number of views, or a statistic
    is_total: ClassVar[bool] = False  # whether to multiply the mean by the number of training views

    @abstractmethod
    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        """Add the values of a view to `total`, [components, capacity].  grad_mean2d: [2, capacity] px⁻¹."""


class ScreenGrad(Statistic):
    """Norm of the gradient with respect to the projected mean, in normalized device coordinates (Kerbl et al. 2023).

    Published thresholds have the same unit.
    """

    type: Literal["screen_grad"] = "screen_grad"

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_norm(
            **_arguments(gaussians, gradients.frame), planes=grad_mean2d, first=0, total=total
        )


class ScreenGradAbs(Statistic):
    """`screen_grad` with absolute values summed over pixels, which do not cancel (AbsGS, Ye et al. 2024)."""

    type: Literal["screen_grad_abs"] = "screen_grad_abs"
    pixel_sums = ABS_X + 2

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_norm(
            **_arguments(gaussians, gradients.frame), planes=gradients.pixel_sums, first=ABS_X, total=total
        )


class ScreenGradAbsSum(Statistic):
    """The absolute sums of `screen_grad_abs`, x plus y (Gaussian Opacity Fields, Yu et al. 2024)."""

    type: Literal["screen_grad_abs_sum"] = "screen_grad_abs_sum"
    pixel_sums = ABS_X + 2

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_sum(
            **_arguments(gaussians, gradients.frame), planes=gradients.pixel_sums, first=ABS_X, total=total
        )


class Texture(Statistic):
    """Mean gradient magnitude of the photographs under the splat, per px: Σ α T |∇I| / Σ α T over all pixels and views.

    Masked pixels are ignored.
    """

    type: Literal["texture"] = "texture"
    pixel_sums = TEXTURE + 1
    divisor = "blend_weight"

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        _add_pixel_sum(gaussians, gradients, TEXTURE, total)


class ScreenRadius(Statistic):
    """Radius of the splat, three standard deviations, px."""

    type: Literal["screen_radius"] = "screen_radius"

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        gaussians.device.program("density.cl").accumulate_radius(
            items=gaussians.count, radius=gradients.frame.radius, total=total, count=gaussians.count
        )


class BlendWeight(Statistic):
    """Weight of a splat in the image: α T, summed over the pixels that are not masked."""

    type: Literal["blend_weight"] = "blend_weight"
    pixel_sums = TEXTURE + 1

    def add(self, gaussians: Gaussians, gradients: ViewGradients, grad_mean2d: Array, total: Array) -> None:
        _add_pixel_sum(gaussians, gradients, WEIGHT, total)


StatisticName = Annotated[str, VariantName(Statistic, lambda cls: cls.components == 1)]


# Statistics that the parameter update can accumulate, each with its bit in adam.cl.
_MEAN2D, _SEEN, _NORM, _ABS_NORM = (
    int(constants("adam.cl")[f"OUTPUT_{name}"]) for name in ("MEAN2D", "SEEN", "NORM", "ABS_NORM")
)
IN_UPDATE = {"screen_grad": _NORM, "screen_grad_abs": _ABS_NORM}

# Statistics that only launch kernels, with arguments that depend only on sizes and memory.
PLANNED = {"screen_grad", "screen_grad_abs", "screen_grad_abs_sum", "texture", "screen_radius", "blend_weight"}


class SplatStats:
    """The statistics of a model, and the number of views in which each Gaussian is visible.

    In shapes, S is the capacity of the tables.
    """

    def __init__(
        self, gaussians: Gaussians, names: Collection[str] = ("screen_grad",), training_views: int = 1
    ) -> None:
        """Add the tables of `names` and their divisors, and delete all other tables.  Existing sums are kept."""
        self.gaussians, self.training_views = gaussians, training_views
        self._plans = Plans(gaussians.device)
        classes = variants(Statistic)
        all_names = {*names, *(classes[name].divisor for name in names)}
        self.columns = {name: cls() for name, cls in classes.items() if name in all_names}
        self._in_update = next((name for name in IN_UPDATE if name in self.columns), None)
        tables = {SEEN: 1} | {PREFIX + name: column.components for name, column in self.columns.items()}
        for name in [name for name in gaussians.tables if name.startswith(PREFIX) and name not in tables]:
            del gaussians.tables[name]
        for name, components in tables.items():
            if name not in gaussians.tables:
                gaussians.add(name, components, zero_fresh=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the statistics, in the order in which their classes are defined."""
        return tuple(self.columns)

    @property
    def pixel_sums(self) -> int:
        """The number of sums over pixels that the backward pass must compute for these statistics."""
        return max((column.pixel_sums for column in self.columns.values()), default=PIXEL_SUMS)

    def total(self, name: str) -> Array:
        """Return the sums of a statistic over views, [components, S]."""
        return self.gaussians[PREFIX + name]

    def divisor(self, name: str) -> Array:
        """Return the sums, [S], by which a statistic is divided."""
        return self.gaussians[PREFIX + self.columns[name].divisor]

    def factor(self, name: str) -> int:
        """Return the factor by which the mean of a statistic is multiplied: the number of training views, or 1."""
        return self.training_views if self.columns[name].is_total else 1

    @property
    def view_count(self) -> Array:
        """The number of views in which each Gaussian is visible, [S]."""
        return self.gaussians[SEEN]

    @property
    def is_in_update(self) -> bool:
        """Whether `Adam.update` adds a view to all statistics."""
        return len(self.columns) == bool(self._in_update)

    def update_arguments(self) -> dict[str, Any]:
        """Return arguments with which `Adam.update` adds a view to the number of views and to at most one statistic."""
        name = self._in_update
        bits = _SEEN | (IN_UPDATE[name] if name else 0) | (0 if self.is_in_update else _MEAN2D)
        return {"seen": self.view_count, "norms": self.total(name) if name else self.view_count, "outputs": bits}

    def add(self, gradients: ViewGradients, grad_mean2d: Array, after_update: bool = False) -> None:
        """Add a view to all statistics.  grad_mean2d: [2, S] px⁻¹.

        after_update: skip the statistics to which `Adam.update` has already added the view.
        """
        gaussians, frame = self.gaussians, gradients.frame
        names = [name for name in self.columns if not (after_update and name == self._in_update)]
        if after_update and not names:
            return

        def launch() -> None:
            if not after_update:
                gaussians.device.program("density.cl").count_seen(
                    items=gaussians.count, radius=frame.radius, seen=self.view_count, count=gaussians.count
                )
            for name in filter(PLANNED.__contains__, names):
                self.columns[name].add(gaussians, gradients, grad_mean2d, self.total(name))

        arrays = grad_mean2d, gradients.pixel_sums, frame.radius
        size = frame.camera.width, frame.camera.height
        key = "statistics", gaussians.key, size, after_update, *(array.buffer.serial for array in arrays)
        self._plans.run(key, {}, launch)
        for name in names:
            if name not in PLANNED:
                self.columns[name].add(gaussians, gradients, grad_mean2d, self.total(name))

    def mean(self, name: str) -> NDArray[np.float32]:
        """Return the mean of a scalar statistic, on the host, [N]; 0 where the divisor is 0."""
        return self.means(name)[:, 0]

    def means(self, name: str) -> NDArray[np.float32]:
        """Return the means of all components of a statistic, on the host, [N, components]; 0 where the divisor is 0."""
        total, divisor = (self.gaussians.get(PREFIX + table) for table in (name, self.columns[name].divisor))
        return np.divide(total, divisor, out=np.zeros_like(total), where=divisor > 0) * np.float32(self.factor(name))

    def clear(self) -> None:
        """Set all sums to zero."""
        for name in self.gaussians.tables:
            if name.startswith(PREFIX):
                self.gaussians[name].fill(0)


def _add_pixel_sum(gaussians: Gaussians, gradients: ViewGradients, pixel_sum: int, total: Array) -> None:
    gaussians.device.program("density.cl").accumulate_pixel_sum(
        items=gaussians.count,
        pixel_sums=gradients.pixel_sums,
        radius=gradients.frame.radius,
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
