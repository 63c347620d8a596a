"""Transforms of the photograph before a step compares it: each depends on the photograph and the step."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from clsplat.core.schedule import NonNegative, at_step
from clsplat.core.settings import Settings
from clsplat.opencl.device import Array
from clsplat.photos.appearance import ByNumber, adam_step
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace

REACH = 3  # standard deviations of a blur's window


@dataclass(frozen=True)
class Planes:
    """A photograph as floats on the device, zero outside the image; valid until the next step."""

    workspace: Workspace
    camera: DeviceCamera
    colours: Array  # [3, rows, stride] in [0, 1]
    mask: Array | None  # [1, rows, stride], 1 in pixels that count, else 0; None: all count
    numbers: Mapping[str, float] = field(default_factory=dict)  # of the transform that learns, by name
    source: Array | None = None  # the colours that it was given


class PhotographTransform(Settings):
    """A change of the photograph before it is compared with the rendered image; the file stays unchanged."""

    @abstractmethod
    def apply(self, planes: Planes, step: int) -> Planes:
        """Return the photograph of a global step; it may depend on its arguments only."""


class Blur(PhotographTransform):
    """Blur the photograph by a Gaussian; masked pixels do not count."""

    type: Literal["blur"] = "blur"
    sigma: NonNegative
    """Standard deviation in px of the photograph at its training size; by step."""

    def apply(self, planes: Planes, step: int) -> Planes:
        sigma = at_step(self.sigma, step)
        return planes if sigma == 0 else _averaged(planes, math.ceil(REACH * sigma), 0.5 / sigma**2)


class MeanFilter(PhotographTransform):
    """Replace a pixel by the mean of a square about it (Opti3DGS, Farooq et al. 2025); masked pixels do not count."""

    type: Literal["mean_filter"] = "mean_filter"
    width: NonNegative
    """Side of the square as a share of the photograph's width; the nearest odd number of px is taken; by step."""

    def apply(self, planes: Planes, step: int) -> Planes:
        return _averaged(planes, math.floor(at_step(self.width, step) * planes.camera.width / 2), 0.0)


def _averaged(planes: Planes, reach: int, falloff: float) -> Planes:
    """Average the pixels within `reach` px in x and in y, by weights exp(-falloff distance²); falloff: px⁻²."""
    if reach == 0:
        return planes
    camera, device = planes.camera, planes.workspace.device
    reach = min(reach, max(camera.width, camera.height))
    sums = planes.workspace.array("blur", (4, camera.rows, camera.stride))
    items, size = (camera.width, camera.height), {"reach": reach, **camera.plane_arguments()}
    program, mask = device.program("blur.cl"), planes.mask
    program.blur_rows(
        items=items,
        image=planes.colours,
        mask=mask or sums,
        sums=sums,
        masked=int(mask is not None),
        falloff=falloff,
        **size,
    )
    program.blur_columns(items=items, sums=sums, image=planes.colours, falloff=falloff, **size)
    return planes


# A transform of the photograph whose numbers training learns, together with the Gaussians, and their Adam.


class LearnedTransform(PhotographTransform):
    """A transform with numbers of its own, which training learns; it stands last, and there is one at most.

    Its `apply` leaves the colours that it is given as they are, and returns them as `source`.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    rate_keys: ClassVar[frozenset[str]] = frozenset({"rate"})

    rate: NonNegative
    """Learning rate of the numbers; by step."""

    @abstractmethod
    def first(self) -> ByNumber:
        """Return the numbers before the first step, by names that no other part of a run uses."""

    @abstractmethod
    def penalty(self, numbers: ByNumber, step: int) -> tuple[float, ByNumber]:
        """Return a loss of the numbers alone, and its derivatives."""

    @abstractmethod
    def backward(self, planes: Planes, gradient: Array) -> Callable[[], ByNumber]:
        """Begin the derivatives by the numbers of what `apply` returned; the result waits for them.

        gradient: by the colours of `planes`, [3, rows, stride], zero outside the image and where the mask is.
        """

    def now(self, numbers: Mapping[str, float]) -> ByNumber:
        """Return the transform's own numbers; the first ones where there are none yet."""
        return {name: numbers.get(name, first) for name, first in self.first().items()}

    def update(self, numbers: dict[str, float], gradients: ByNumber, step: int) -> None:
        """Change the numbers by Adam."""
        adam_step(numbers, self.now(numbers), gradients, at_step(self.rate, step))


def learned_of(transforms: Sequence[PhotographTransform]) -> LearnedTransform | None:
    """Return the transform that learns, or None.  Raises ValueError where another one follows it."""
    learned = [transform for transform in transforms if isinstance(transform, LearnedTransform)]
    if learned and learned[0] is not transforms[-1]:
        name = name_of(learned[0])
        raise ValueError(f"a transform follows '{name}', which learns; expected one that learns at the end of the list")
    return learned[0] if learned else None


def name_of(transform: PhotographTransform) -> str:
    """Return the name of a transform in pipeline files; that of its class where it has none."""
    return str(getattr(transform, "type", type(transform).__name__))
