"""AutoOpti3DGS: a photograph without its finest details, which a filter that is learned lets return."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import NonNegative, at_step
from clsplat.losses.base import Comparison, ImageLoss, Loss, LossValue
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import ByNumber, adam_step
from clsplat.photos.photographs import apply_mask
from clsplat.photos.transforms import Planes
from clsplat.training.modules.base import ModuleState, Scalars, TrainingModule, TrainingStep
from clsplat.training.run import Run

STRIP = int(constants("haar.cl")["STRIP"])
NAMES = {"filter": ("haar/scale", "haar/leak"), "scale": ("haar/scale",)}


class Haar(TrainingModule):
    """Take the photograph's finest details away, and let them return as a filter is learned (AutoOpti3DGS, Nguyen et
    al. 2025).

    The photograph passes one level of the Haar transform and back.  The high-pass filter of the way there is
    h = s (1, -1) / √2 + l (1, 1) / √2 with scale s and leak l, which are learned and begin at zero: squares of 2 x 2 px
    are their mean.  They follow the losses on images, and one of their own, weight · 2 ((1 - s)² + l²), which pulls h
    to Haar's, where the photograph is as it was.  Pixels that a mask leaves out are the mean of those of their square
    that count.  All losses on images must be the same with image and photograph exchanged.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "weight"})
    rate_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    order: ClassVar[int] = 10  # before what compares the photograph with the image
    device_planes: ClassVar[int] = 6  # the photograph that is changed, and its gradient

    type: Literal["haar"] = "haar"
    learn: Literal["filter", "scale"] = "filter"
    """Scale and leak, which is every filter of two taps, or the scale alone."""
    rate: NonNegative = 1.0e-4
    """Learning rate of the filter, by Adam; it decides how fast details return; by step."""
    weight: NonNegative = 0.05
    """Factor of the loss that pulls the filter to Haar's; by step."""

    def create_state(self, run: Run) -> "HaarState":
        return HaarState(self)

    def check_losses(self, losses: Sequence[Loss]) -> None:
        for loss in losses:
            if isinstance(loss, ImageLoss) and loss.reads_photograph and not loss.symmetric:
                name = getattr(loss, "type", getattr(loss, "name", type(loss).__name__))
                raise ConfigError(
                    f"the loss '{name}', where '{self.type}' learns: expected losses that are the same with image and "
                    "photograph exchanged, such as l1, l2 and dssim; the class of one says `symmetric = True`"
                )

    def penalty(self, scalars: Scalars, step: int) -> tuple[float, ByNumber]:
        """Return the loss of the filter alone, and its derivatives."""
        weight = at_step(self.weight, step)
        away = {name: value - (name == "haar/scale") for name, value in scalars.items()}
        value = weight * 2 * sum(one**2 for one in away.values())
        return value, {name: 4 * weight * one for name, one in away.items()}


class HaarState(ModuleState):
    """The filter, and its Adam."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Haar) -> None:
        super().__init__()
        self.settings = settings

    @property
    def filter(self) -> ByNumber:
        """What is learned, by name."""
        return {name: self.scalars.get(name, 0.0) for name in NAMES[self.settings.learn]}

    def after_render(self, step: TrainingStep) -> None:
        step.save(self, step.planes)
        step.planes = apply_filter(step.planes, self.filter)

    def before_losses(self, step: TrainingStep) -> None:
        """A loss keeps the sums of its last call, so that the gradient by the photograph comes before its value."""
        self.settings.check_losses(step.loss_settings)
        gradient = gradient_by_photograph(step.loss_settings, step.comparison)
        if step.planes.mask is not None:
            apply_mask(step.workspace, step.camera, gradient, step.planes.mask)
        of_images = filter_gradients(step.saved(self), self.filter, gradient)
        value, of_filter = self.settings.penalty(self.filter, step.number)
        step.module_losses.append(LossValue(self.settings.type, lambda: value))
        step.save(self, (of_images, of_filter))

    def update(self, step: TrainingStep) -> None:
        of_images, of_filter = step.saved(self)
        by_images = of_images()
        self.learn({name: by_images[name] + own for name, own in of_filter.items()}, step.number)

    def learn(self, gradients: ByNumber, step: int) -> None:
        """Change the filter by Adam."""
        adam_step(self.scalars, self.filter, gradients, at_step(self.settings.rate, step))


def apply_filter(planes: Planes, scalars: ByNumber) -> Planes:
    """Return a photograph after the transform; the colors of `planes` stay as they are."""
    camera, workspace = planes.camera, planes.workspace
    found = workspace.array("haar", planes.colors.shape)
    workspace.device.program("haar.cl").haar_forward(
        items=(camera.stride // 2, camera.rows // 2),
        image=planes.colors,
        found=found,
        **_arguments(planes, scalars, found),
    )
    return replace(planes, colors=found)


def filter_gradients(planes: Planes, scalars: ByNumber, gradient: Array) -> Callable[[], ByNumber]:
    """Begin the derivatives by scale and leak of what `apply_filter` returned of `planes`; the result waits for them.

    gradient: by those colors, [3, rows, stride], zero outside the image and where the mask is.
    """
    columns, strips = planes.camera.stride // 2, -(-planes.camera.rows // (2 * STRIP))
    sums = planes.workspace.array("haar sums", (2, strips, columns))
    planes.workspace.device.program("haar.cl").haar_backward(
        items=(columns, strips),
        image=planes.colors,
        gradient=gradient,
        sums=sums,
        **_arguments(planes, scalars, sums),
    )
    copied = sums.get_later()

    def derivatives() -> ByNumber:
        by_u, by_v = (float(part.sum(dtype=np.float64)) for part in copied())
        return dict(zip(NAMES["filter"], (by_u - by_v, by_u + by_v), strict=True))

    return derivatives


def _arguments(planes: Planes, scalars: ByNumber, unread: Array) -> dict[str, Any]:
    """Arguments of both kernels; `unread` stands in the place of a mask."""
    scale, leak = scalars["haar/scale"], scalars.get("haar/leak", 0.0)
    masked, sizes = int(planes.mask is not None), planes.camera.plane_arguments()
    return {"mask": planes.mask or unread, "masked": masked, "u": leak + scale, "v": leak - scale, **sizes}


def gradient_by_photograph(losses: Sequence[Loss], comparison: Comparison) -> Array:
    """Return the gradient of symmetric losses by the photograph, [3, rows, stride]; the image's is left as it is."""
    gradient = comparison.workspace.array("grad_photograph", comparison.photograph.shape)
    image, photograph = comparison.photograph, comparison.image
    exchanged = replace(comparison, image=image, photograph=photograph, gradient=gradient, accumulate=False)
    compared = [loss for loss in losses if isinstance(loss, ImageLoss) and loss.reads_photograph]
    if not compared:
        gradient.fill(0)
    for loss in compared:
        loss.add(exchanged)
    return gradient
