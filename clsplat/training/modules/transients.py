"""Pixels that do not count since their photograph shows what the scene does not have: people, cars, reflections.

Found by their residuals alone (SpotLessSplats, Sabour et al. 2024, without its network; RobustSplat, Fu et al. 2025).
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

_NAMES = constants("transients.cl")
BINS, FIRST_BIN, BIN_SHIFT = (int(_NAMES[name]) for name in ("BINS", "FIRST_BIN", "BIN_SHIFT"))
KEYS = tuple(f"{k:02d}" for k in range(BINS))
TAIL = 0.99  # share of the pixels


class Transients(TrainingModule):
    """Leave out the pixels of a photograph that differ much more from the image than most do.

    A residual is a pixel's absolute difference, the mean over channels.  The distribution of all views' residuals is
    kept over the steps.  While its 99 % quantile is more than `tail` times its `quantile`, pixels of more than `above`
    times that do not count, where most of the box about them has more too: details that a model does not have yet are
    thin.  They are black in both images, as those of a mask file.  The two factors are ours.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "quantile", "above", "tail", "box", "decay"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    device_planes: ClassVar[int] = 2  # residuals, and the mask that leaves out the large ones
    order: ClassVar[int] = 90  # they compare what all others have made of both images

    type: Literal["transients"] = "transients"
    start: Annotated[int, Field(ge=0)]
    """Global step after which pixels are left out: where the scene is there, but not yet what passes through it."""
    quantile: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """Share of the pixels whose residuals are those of the scene."""
    above: Annotated[float, Field(ge=1)] = 3.0
    """Residual from which on a pixel is left out, in units of that quantile."""
    tail: Annotated[float, Field(ge=0)] = 6.0
    """99 % quantile above which photographs hold something else, in the same units; 0: they do in any case."""
    box: Annotated[float, Field(ge=0, lt=1)] = 0.04
    """Side of the box, a share of the photograph's width; the nearest odd number of px from 3 on is taken."""
    decay: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Share of the distribution that stays at a step."""

    def threshold(self, scalars: Mapping[str, float], step: int) -> float | None:
        """Return the residual from which on pixels of a global step are left out; None where all count."""
        reached = np.cumsum([scalars.get(key, 0.0) for key in KEYS])
        if step <= self.start or reached[-1] == 0:
            return None
        most, tail = (_upper(int((reached < share * reached[-1]).sum())) for share in (self.quantile, TAIL))
        return self.above * most if tail > self.tail * most else None

    def create_state(self, run: Run) -> ModuleState:
        return TransientsState(self)

    def learn(self, scalars: Scalars, counts: NDArray[np.uint32]) -> None:
        """Add the residuals of a step, [BINS], to the distribution."""
        for key, count in zip(KEYS, counts, strict=True):
            scalars[key] = self.decay * scalars.get(key, 0.0) + float(count)


def _upper(bin_number: int) -> float:
    """The least residual above a bin: its upper bits are those of the next one."""
    return float(np.array(FIRST_BIN + bin_number + 1 << BIN_SHIFT, np.int32).view(np.float32))


class TransientsState(ModuleState):
    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Transients) -> None:
        super().__init__()
        self.settings = settings

    def after_render(self, step: TrainingStep) -> None:
        workspace, camera, planes = step.workspace, step.camera, step.planes
        residuals, counts = measure_residuals(workspace, camera, step.image, planes.colors, planes.mask)
        if (threshold := self.settings.threshold(self.scalars, step.number)) is not None:
            reach = max(1, round(self.settings.box * camera.width / 2))
            step.planes = replace(planes, mask=mask_transients(workspace, camera, residuals, threshold, reach))
        step.save(self, counts)

    def update(self, step: TrainingStep) -> None:
        self.settings.learn(self.scalars, step.saved(self)())


def measure_residuals(
    workspace: Workspace, camera: DeviceCamera, image: Array, photograph: Array, mask: Array | None
) -> tuple[Array, Callable[[], NDArray[np.uint32]]]:
    """Return the residuals of planes [3, rows, stride], [1, rows, stride], and a wait for their number by bin, [BINS].

    mask: [1, rows, stride], 1 in pixels that count; None: all count.
    """
    residuals = workspace.array("residuals", (1, camera.rows, camera.stride))
    numbers = workspace.array("residual numbers", BINS, np.uint32)
    numbers.fill(0)
    workspace.device.program("transients.cl").measure_residuals(
        groups=(1, camera.rows),
        image=image,
        photograph=photograph,
        mask=mask or residuals,
        residuals=residuals,
        numbers=numbers,
        masked=int(mask is not None),
        **camera.plane_arguments(),
    )
    return residuals, numbers.get_later()


def mask_transients(
    workspace: Workspace, camera: DeviceCamera, residuals: Array, threshold: float, reach: int
) -> Array:
    """Return the mask of pixels that count, [1, rows, stride], of residuals [1, rows, stride].

    reach: px from the middle of a pixel's box to its edges.
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
