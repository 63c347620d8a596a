"""The sample of a training step: a view, at a size, with transforms of its photograph."""

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import Field, field_validator

from clsplat.scene.scene import View
from clsplat.schedule import AtLeastOne, at_step
from clsplat.settings import OneOf, Settings
from clsplat.views.learned import learned_of
from clsplat.views.order import Order, Uniform, ViewPool
from clsplat.views.transforms import PhotographTransform


class ViewSettings(Settings):
    """The sample of each step: a view, its size and transforms of its photograph."""

    order: OneOf[Order] = Uniform()
    """Which view a step trains on."""
    resolution: AtLeastOne = 1.0
    """Divisor of the photographs' size beside `scene.downscale`, at least 1; by step."""
    transforms: list[OneOf[PhotographTransform]] = Field(default=[])
    """Transforms of the photograph, in order; one that learns stands last."""

    @field_validator("transforms")
    @classmethod
    def _learning_at_the_end(cls, transforms: list[PhotographTransform]) -> list[PhotographTransform]:
        learned_of(transforms)
        return transforms


@dataclass(frozen=True)
class Sample:
    """The sample of one step."""

    view: View  # at the size of the step
    original: View  # at the size that is trained on
    transforms: Sequence[PhotographTransform]
    step: int  # global


class Sampler:
    """Samples by step: they depend on the views, the seed and the step."""

    def __init__(self, views: Sequence[View], settings: ViewSettings, seed: int) -> None:
        self.settings, self._pool = settings, ViewPool(views, seed)

    def at(self, step: int) -> Sample:
        """Return the sample of a global step, counted from 1."""
        view, divisor = self.settings.order.at(self._pool, step), at_step(self.settings.resolution, step)
        return Sample(view.resized(view.downscale * divisor), view, self.settings.transforms, step)
