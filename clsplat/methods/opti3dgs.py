"""Restore the finest details of photos while a wavelet filter is learned (AutoOpti3DGS, Nguyen et al. 2025)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import NonNegative, at_step
from clsplat.losses.base import Comparison, ImageLoss, Loss, LossValue
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import adam_step
from clsplat.photos.photographs import apply_mask
from clsplat.photos.transforms import Planes
from clsplat.training.modules.base import ModuleState, Scalars, TrainingModule, TrainingStep
from clsplat.training.run import Run

STRIP = int(constants("haar.cl")["STRIP"])
NAMES = {"filter": ("haar/scale", "haar/leak"), "scale": ("haar/scale",)}


class Haar(TrainingModule):
    """Remove the finest details of the photo, and restore them while a filter is learned (AutoOpti3DGS, Nguyen et al.
    2025).

    The photo passes through one level of the Haar transform and its inverse.  The high-pass analysis filter is
    h = s (1, -1) / √2 + l (1, 1) / √2 with learned scale s and leak l.  Both start at zero, so that the photo is
    averaged over squares of 2 x 2 px.  They are trained by the losses on images and by the loss
    weight · 2 ((1 - s)² + l²).  This loss pulls h toward Haar's filter, with which the photo does not change.  A masked
    pixel becomes the mean of the unmasked pixels in its square.  All losses on images must be symmetric in render and
    photo.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "weight"})
    rate_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    order: ClassVar[int] = 10  # before the modules that compare the photo with the render
    device_planes: ClassVar[int] = 6  # the filtered photo, and its gradient

    type: Literal["haar"] = "haar"
    learn: Literal["filter", "scale"] = "filter"
    """`filter`: scale and leak, which can represent any filter with two taps; `scale`: only the scale."""
    rate: NonNegative = 1.0e-4
    """Learning rate of the filter (Adam); it determines how fast details return."""
    weight: NonNegative = 0.05
    """Weight of the loss that pulls the filter toward Haar's filter."""

    def create_state(self, run: Run) -> "HaarState":
        return HaarState(self)

    def check_losses(self, losses: Sequence[Loss]) -> None:
        for loss in losses:
            if isinstance(loss, ImageLoss) and loss.reads_photograph and not loss.symmetric:
                name = getattr(loss, "type", getattr(loss, "name", type(loss).__name__))
                raise ConfigError(
                    f"the loss '{name}' is not symmetric in render and photo, as '{self.type}' requires; use l1, l2, "
                    "or dssim, or set `symmetric = True` in the class if the loss is symmetric"
                )

    def penalty(self, scalars: Scalars, step: int) -> tuple[float, Scalars]:
        """Return the loss that pulls the filter toward the Haar filter, and its derivatives."""
        weight = at_step(self.weight, step)
        offsets = {name: value - (name == "haar/scale") for name, value in scalars.items()}
        value = weight * 2 * sum(offset**2 for offset in offsets.values())
        return value, {name: 4 * weight * offset for name, offset in offsets.items()}


class HaarState(ModuleState):
    """The filter and its Adam moments."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Haar) -> None:
        super().__init__()
        self.settings = settings

    @property
    def filter(self) -> Scalars:
        """The learned parameters by name."""
        return {name: self.scalars.get(name, 0.0) for name in NAMES[self.settings.learn]}

    def after_render(self, step: TrainingStep) -> None:
        step.save(self, step.planes)
        step.planes = apply_filter(step.planes, self.filter)

    def before_losses(self, step: TrainingStep) -> None:
        """Compute the photo's gradient first, because a loss keeps only the sums of its last call."""
        self.settings.check_losses(step.loss_settings)
        gradient = photograph_gradient(step.loss_settings, step.comparison)
        if step.planes.mask is not None:
            apply_mask(step.workspace, step.camera, gradient, step.planes.mask)
        image_gradients = filter_gradients(step.saved_value(self), self.filter, gradient)
        value, penalty_gradients = self.settings.penalty(self.filter, step.number)
        step.module_losses.append(LossValue(self.settings.type, lambda: value))
        step.save(self, (image_gradients, penalty_gradients))

    def update(self, step: TrainingStep) -> None:
        wait_for_gradients, penalty_gradients = step.saved_value(self)
        gradients = wait_for_gradients()
        self.learn({name: gradients[name] + value for name, value in penalty_gradients.items()}, step.number)

    def learn(self, gradients: Scalars, step: int) -> None:
        """Update the filter with Adam."""
        adam_step(self.scalars, self.filter, gradients, at_step(self.settings.rate, step))


def apply_filter(planes: Planes, scalars: Scalars) -> Planes:
    """Return the planes with the filtered photo; the colors of `planes` do not change."""
    camera, workspace = planes.camera, planes.workspace
    filtered_colors = workspace.array("haar", planes.colors.shape)
    workspace.device.program("haar.cl").haar_forward(
        items=(camera.stride // 2, camera.rows // 2),
        image=planes.colors,
        result=filtered_colors,
        **_arguments(planes, scalars, filtered_colors),
    )
    return replace(planes, colors=filtered_colors)


def filter_gradients(planes: Planes, scalars: Scalars, gradient: Array) -> Callable[[], Scalars]:
    """Start computing the gradient of the filter's parameters; return a function that waits for it.

    planes: the arguments of `apply_filter`.  gradient: with respect to the filtered colors, [3, rows, stride], zero
    outside the image and in masked pixels.
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
    group_sums = sums.get_later()

    def derivatives() -> Scalars:
        grad_u, grad_v = (float(part.sum(dtype=np.float64)) for part in group_sums())
        return dict(zip(NAMES["filter"], (grad_u - grad_v, grad_u + grad_v), strict=True))

    return derivatives


def _arguments(planes: Planes, scalars: Scalars, placeholder: Array) -> dict[str, Any]:
    """Return the arguments of both kernels.  placeholder: any array, passed if there is no mask."""
    scale, leak = scalars["haar/scale"], scalars.get("haar/leak", 0.0)
    is_masked, sizes = int(planes.mask is not None), planes.camera.plane_arguments()
    return {"mask": planes.mask or placeholder, "masked": is_masked, "u": leak + scale, "v": leak - scale, **sizes}


def photograph_gradient(losses: Sequence[Loss], comparison: Comparison) -> Array:
    """Return the gradient of symmetric losses with respect to the photo, [3, rows, stride].

    The gradient with respect to the render does not change.
    """
    gradient = comparison.workspace.array("grad_photograph", comparison.photograph.shape)
    image, photograph = comparison.photograph, comparison.image
    swapped_comparison = replace(comparison, image=image, photograph=photograph, gradient=gradient, accumulate=False)
    image_losses = [loss for loss in losses if isinstance(loss, ImageLoss) and loss.reads_photograph]
    if not image_losses:
        gradient.fill(0)
    for loss in image_losses:
        loss.add(swapped_comparison)
    return gradient
