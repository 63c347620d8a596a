"""Mask transient objects, such as people and cars, by the residuals of their pixels.

The method follows SpotLessSplats (Sabour et al. 2024), without its network, and RobustSplat (Fu et al. 2025).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.opencl.device import Array, constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.training.modules.base import ModuleState, Scalars, TrainingModule, TrainingStep
from clsplat.training.run import Run

_CONSTANTS = constants("transients.cl")
BINS, FIRST_BIN, BIN_SHIFT = (int(_CONSTANTS[name]) for name in ("BINS", "FIRST_BIN", "BIN_SHIFT"))
KEYS = tuple(f"{k:02d}" for k in range(BINS))
OUTLIER_QUANTILE = 0.99  # quantile by which outliers are detected


class Transients(TrainingModule):
    """Mask the pixels of a photograph that have far larger residuals than most pixels.

    A residual is a pixel's absolute difference, averaged over channels.  A running histogram counts the residuals of
    all views; t is the residual at its `quantile`.  While the 99% quantile exceeds `tail_ratio` t, a pixel is masked if
    its residual, and most residuals in the box around it, exceed `outlier_ratio` t.  Because of the box, thin
    details that the model has not learned yet are not masked.  Masked pixels are black in both the render and the
    photograph, as with mask files.  The two ratios are not from a paper.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"start", "quantile", "outlier_ratio", "tail_ratio", "box_size", "decay"}
    )
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    masks_objects: ClassVar[bool] = True
    device_planes: ClassVar[int] = 2  # residuals and mask
    order: ClassVar[int] = 90  # after all changes of both images

    type: Literal["transients"] = "transients"
    start: Annotated[int, Field(ge=0)]
    """Global step after which pixels are masked, when the model already shows the scene without transients."""
    quantile: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """Quantile of the histogram below which residuals are typical of the static scene."""
    outlier_ratio: Annotated[float, Field(ge=1)] = 3.0
    """Residual above which a pixel is masked, as a multiple of the residual at `quantile`."""
    tail_ratio: Annotated[float, Field(ge=0)] = 6.0
    """Pixels are masked only while the 99% quantile is above this multiple of the residual at `quantile`; 0: always."""
    box_size: Annotated[float, Field(ge=0, lt=1)] = 0.04
    """Side of the box as a fraction of the photo's width, rounded to an odd number of px, at least 3."""
    decay: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Factor by which the counts of the histogram are multiplied in each step."""

    def threshold(self, scalars: Mapping[str, float], step: int) -> float | None:
        """Return the residual above which pixels are masked at a global step; None if no pixels are masked."""
        counts = np.cumsum([scalars.get(key, 0.0) for key in KEYS])
        if step <= self.start or counts[-1] == 0:
            return None
        typical, tail = (_bin_end(int((counts < q * counts[-1]).sum())) for q in (self.quantile, OUTLIER_QUANTILE))
        return self.outlier_ratio * typical if tail > self.tail_ratio * typical else None

    def create_state(self, run: Run) -> ModuleState:
        return TransientsState(self)

    def update_histogram(self, scalars: Scalars, counts: NDArray[np.uint32]) -> None:
        """Decay the histogram, and add the residual counts of a step, [BINS]."""
        for key, count in zip(KEYS, counts, strict=True):
            scalars[key] = self.decay * scalars.get(key, 0.0) + float(count)


def _bin_end(index: int) -> float:
    """Return the smallest residual above a bin.  The index of a bin is the upper bits of a float32, minus FIRST_BIN."""
    return float(np.array(FIRST_BIN + index + 1 << BIN_SHIFT, np.int32).view(np.float32))


class TransientsState(ModuleState):
    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Transients) -> None:
        super().__init__()
        self.settings = settings

    def after_render(self, step: TrainingStep) -> None:
        workspace, camera, planes = step.workspace, step.camera, step.planes
        residuals, counts = measure_residuals(workspace, camera, step.image, planes.colors, planes.mask)
        if (threshold := self.settings.threshold(self.scalars, step.number)) is not None:
            reach = max(1, round(self.settings.box_size * camera.width / 2))
            step.planes = replace(planes, mask=mask_transients(workspace, camera, residuals, threshold, reach))
        step.save(self, counts)

    def update(self, step: TrainingStep) -> None:
        self.settings.update_histogram(self.scalars, step.saved_value(self)())


def measure_residuals(
    workspace: Workspace, camera: DeviceCamera, image: Array, photograph: Array, mask: Array | None
) -> tuple[Array, Callable[[], NDArray[np.uint32]]]:
    """Return the residuals, [1, rows, stride], and a function that waits for their histogram, [BINS], and returns it.

    image, photograph: planes, [3, rows, stride]; mask: [1, rows, stride], 1 in unmasked pixels, or None.
    """
    residuals = workspace.array("residuals", (1, camera.rows, camera.stride))
    counts = workspace.array("residual numbers", BINS, np.uint32)
    counts.fill(0)
    workspace.device.program("transients.cl").measure_residuals(
        groups=(1, camera.rows),
        image=image,
        photograph=photograph,
        mask=mask or residuals,
        residuals=residuals,
        numbers=counts,
        masked=int(mask is not None),
        **camera.plane_arguments(),
    )
    return residuals, counts.get_later()


def mask_transients(
    workspace: Workspace, camera: DeviceCamera, residuals: Array, threshold: float, reach: int
) -> Array:
    """Return a mask, [1, rows, stride], that is 0 for transient objects.

    residuals: [1, rows, stride]; reach: half the side of a pixel's box, px.
    """
    mask = workspace.array("counted pixels", (1, camera.rows, camera.stride))
    workspace.device.program("transients.cl").mask_transients(
        items=(camera.stride, camera.rows),
        residuals=residuals,
        mask=mask,
        threshold=threshold,
        reach=reach,
        width=camera.width,
        height=camera.height,
        stride=camera.stride,
    )
    return mask
