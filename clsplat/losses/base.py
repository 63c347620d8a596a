"""Define the base classes of losses and penalties, which add to a gradient and return their value lazily."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Schedule
from clsplat.core.settings import Settings
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import GaussianGradients
from clsplat.opencl.device import Array
from clsplat.photos.depths import KnownDepths
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Content, Frame, PixelSums
from clsplat.render.workspace import Workspace


@dataclass
class Comparison:
    """A render and its photograph, float planes [3, rows, stride], and the gradient that losses add to.

    Image and gradient have a fourth plane, the inverse depth, if a loss reads it.  Losses are means
    over the entire image, including masked pixels, so that thresholds mean the same with and without a mask.
    """

    workspace: Workspace
    camera: DeviceCamera
    image: Array
    photograph: Array
    gradient: Array
    mask: Array | None = None  # [1, rows, stride] 0 or 1
    step: int = 0  # global step, at which schedules are evaluated
    accumulate: bool = False  # if False, the next loss overwrites the gradient
    depths: KnownDepths | None = None  # at pixels of the photograph, if a loss reads them

    def arguments(self) -> dict[str, Any]:
        """Return the common arguments of kernels that add the gradient of a loss on colors."""
        arrays = {"image": self.image, "photograph": self.photograph, "gradient": self.gradient}
        return {**arrays, "accumulate": int(self.accumulate)}

    @property
    def size(self) -> int:
        """The number of values in the image."""
        return 3 * self.camera.width * self.camera.height

    @property
    def unmasked_size(self) -> int:
        """The number of values in unmasked pixels; waits for the device if there is a mask."""
        return self.size if self.mask is None else 3 * int(self.mask.get().sum())


@dataclass(frozen=True)
class LossValue:
    """The value of a loss at one step.  Reading it waits for the device."""

    name: str
    value: Callable[[], float]  # including the weight


def require_loss_value(loss: "Loss", value: object) -> LossValue:
    """Return the result of a loss's `add`.  Raises ConfigError if it is not a LossValue."""
    if not isinstance(value, LossValue):
        raise ConfigError(
            f"the loss {type(loss).__name__}: expected a LossValue from 'add', got {type(value).__name__}"
        )
    return value


@dataclass(frozen=True)
class ViewLosses:
    """A view's frame and its losses; valid until the next view."""

    frame: Frame
    comparison: Comparison
    losses: list[LossValue]
    step: Any = field(default=None, kw_only=True)  # the TrainingStep

    @property
    def loss(self) -> float:
        """The sum of the view's losses, and after an update also of the penalties; waits for the device."""
        return sum(loss.value() for loss in self.losses)


@dataclass(frozen=True)
class ViewGradients(ViewLosses):
    """A view's frame, its losses, and the pixel sums from which gradients are computed; valid until the next view."""

    sums: PixelSums | Array

    @property
    def pixel_sums(self) -> Array:
        """The sums over pixels, [PIXEL_SUMS or more, S]."""
        return self.sums if isinstance(self.sums, Array) else self.sums.array


class Loss(Settings):
    """A term of the objective."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})

    weight: Schedule = 1.0
    """Weight of the loss; may be scheduled."""


class ImageLoss(Loss):
    """A loss on the rendered image."""

    symmetric: ClassVar[bool] = False
    """Whether the value is the same if image and photo are swapped, as the module `haar` requires."""
    reads_photograph: ClassVar[bool] = True
    """Whether the loss compares the image with the photo; training needs at least one such loss."""
    runs_on_host: ClassVar[bool] = False
    """Whether `add` waits for the image.  Others may be called for an incomplete image, whose result is not used."""

    def required_content(self, step: int) -> Content:
        """Return the planes of the image that the loss needs at a global step: colors, or colors and inverse depth."""
        return "color"

    @abstractmethod
    def add(self, comparison: Comparison) -> LossValue:
        """Add weight · d(loss)/d(image) to the gradient."""


@dataclass(frozen=True)
class PenaltyInputs:
    """The inputs of a penalty: the Gaussians, and the gradients that it adds to."""

    workspace: Workspace
    gaussians: Gaussians
    gradients: GaussianGradients
    extent: float  # scene units
    step: int  # global

    @property
    def items(self) -> int:
        """The number of work-items of a kernel that processes LANES Gaussians per work-item."""
        return -(-self.gaussians.count // int(self.gaussians.device.tuning["LANES"]))

    def sums(self, name: str) -> Array:
        """Return an array for one sum per work-item, [items].  name: must be unique among the penalties of a step."""
        return self.workspace.array(f"{name} sums", self.items)

    def arguments(self, parameter: str) -> dict[str, Any]:
        """Return the common arguments of penalty kernels: `<parameter>`, `grad_<parameter>`, and sizes."""
        return {
            "items": self.items,
            parameter: self.gaussians[parameter],
            f"grad_{parameter}": self.gradients[parameter],
            "stride": self.gaussians.capacity,
            "count": self.gaussians.count,
        }


class Penalty(Loss):
    """A loss on the parameters of the Gaussians, not on an image."""

    @property
    def tables(self) -> set[str]:
        """The tables of Gaussians that the penalty reads in addition to the parameters."""
        return set()

    @abstractmethod
    def add(self, inputs: PenaltyInputs) -> LossValue:
        """Add weight · d(penalty)/d(parameter) to the gradients of the penalty's parameters."""


def required_content(losses: Sequence[Loss], step: int) -> Content:
    """Return the planes of the rendered image that the losses need at a global step.

    Raises ConfigError for a loss that is neither an ImageLoss nor a Penalty.
    """
    for loss in losses:
        if not isinstance(loss, ImageLoss | Penalty):
            raise ConfigError(f"the loss {type(loss).__name__}: expected a subclass of ImageLoss or of Penalty")
    has_depth = any(loss.required_content(step) == "inverse_depth" for loss in losses if isinstance(loss, ImageLoss))
    return "inverse_depth" if has_depth else "color"
