"""The sample of a training step: a view, at a size, with transforms of its photograph."""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from clsplat.errors import ConfigError
from clsplat.scene.scene import View
from clsplat.schedule import AtLeastOne, Points, at_step, explained
from clsplat.settings import OneOf, Settings
from clsplat.views.detail import DetailDivisor, course
from clsplat.views.learned import learned_of
from clsplat.views.order import Order, Uniform, ViewPool
from clsplat.views.transforms import PhotographTransform

LOG = logging.getLogger("clsplat")


class ViewSettings(Settings):
    """The sample of each step: a view, its size and transforms of its photograph."""

    order: OneOf[Order] = Uniform()
    """Which view a step trains on."""
    resolution: Annotated[DetailDivisor | AtLeastOne, explained(", or {follows: detail, until, …}")] = 1.0
    """Divisor of the photographs' size beside `scene.downscale`, at least 1: by step, or from their detail."""
    transforms: list[OneOf[PhotographTransform]] = Field(default=[])
    """Transforms of the photograph, in order; one that learns stands last."""

    @field_validator("transforms")
    @classmethod
    def _learning_at_the_end(cls, transforms: list[PhotographTransform]) -> list[PhotographTransform]:
        learned_of(transforms)
        return transforms

    def settled(self, photographs: Callable[[], Iterable[NDArray[np.uint8]]]) -> "ViewSettings":
        """Return settings in which what follows from the training photographs, each [height, width, 3], is a number by
        step."""
        if not isinstance(self.resolution, DetailDivisor):
            return self
        found = self.resolution.of(photographs())
        LOG.info(course(found))
        return self.model_copy(update={"resolution": found})

    def divisor(self, step: int) -> float:
        """Return the divisor of the photographs' size at a global step.  Raises ConfigError before it is settled."""
        if isinstance(self.resolution, DetailDivisor):
            raise ConfigError("a resolution that follows detail needs photographs: expected what `settled` returns")
        return at_step(self.resolution, step)

    @property
    def changes(self) -> list[float]:
        """The global steps between which the size stays, or changes evenly; none where it does not change."""
        resolution = self.resolution
        if isinstance(resolution, DetailDivisor):
            return [float(step) for step in resolution.changes]
        points = resolution.points if isinstance(resolution, Points) else resolution
        return [step for step, _ in points] if isinstance(points, list) else []

    @property
    def last_change(self) -> float:
        """The global step of the last change of the size, at the latest; 0 where it does not change."""
        return self.resolution.until if isinstance(self.resolution, DetailDivisor) else max([0.0, *self.changes])

    def full_size(self, last: int) -> int:
        """Return the first step up to `last` whose photographs are larger than 1/2 of their size."""
        return next((step for step in range(1, last + 1) if self.divisor(step) < 2), last)


@dataclass(frozen=True)
class Sample:
    """The sample of one step."""

    view: View  # at the size of the step
    original: View  # at the size that is trained on
    number: int  # of it among the training views
    transforms: Sequence[PhotographTransform]
    step: int  # global


class Sampler:
    """Samples by step: they depend on the views, the seed and the step."""

    def __init__(self, views: Sequence[View], settings: ViewSettings, seed: int) -> None:
        self.settings, self._pool = settings, ViewPool(views, seed)
        self._numbers = {id(view): number for number, view in enumerate(views)}

    def at(self, step: int) -> Sample:
        """Return the sample of a global step, counted from 1."""
        view, divisor = self.settings.order.at(self._pool, step), self.settings.divisor(step)
        small = view.resized(view.downscale * divisor)
        return Sample(small, view, self._numbers[id(view)], self.settings.transforms, step)
