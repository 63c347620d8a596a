"""Choose the sample of each training step: a view, its size, and the transforms of its photograph."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import AtLeastOne, Points, at_step, explain_schedule
from clsplat.core.settings import OneOf, Settings
from clsplat.photos.detail import DetailDivisor, describe_sizes
from clsplat.photos.transforms import PhotographTransform
from clsplat.scene.view import View

# The view of each step depends only on the seed and the step, so a resumed run uses the same views.

FINEST_FRACTION = 0.3  # fraction of steps with a random view of the finest size (released code of Mip-Splatting)


class ViewPool:
    """The training views, possibly at several sizes, and their random permutations."""

    def __init__(self, views: Sequence[View], seed: int) -> None:
        finest = min(view.downscale for view in views)
        self.views, self.seed = views, seed
        self.finest = [i for i, view in enumerate(views) if view.downscale == finest]  # indices into `views`
        self._shuffle = lru_cache(maxsize=2)(self._permute)  # the next views may be in the next epoch

    def shuffled_view(self, entries: Sequence[int], step: int) -> View:
        """Return the view of a step.  Each epoch visits all `entries`, which index `views`, in a new order."""
        epoch, index = divmod(step - 1, len(entries))
        return self.views[entries[int(self._shuffle(epoch, len(entries))[index])]]

    def rng(self, step: int) -> np.random.Generator:
        """Return a random number generator that depends only on the seed and the step."""
        return np.random.default_rng([self.seed, step, len(self.views)])

    def _permute(self, epoch: int, count: int) -> NDArray[Any]:
        return np.random.default_rng([self.seed, epoch]).permutation(count)


class Order(Settings):
    """The order in which training visits the views."""

    @abstractmethod
    def view_at(self, pool: ViewPool, step: int) -> View:
        """Return the view of a step, counted from 1.  It must depend only on the pool, its seed, and the step."""


class Uniform(Order):
    """Draw all views at all sizes, in a new random order in each epoch."""

    type: Literal["uniform"] = "uniform"

    def view_at(self, pool: ViewPool, step: int) -> View:
        return pool.shuffled_view(range(len(pool.views)), step)


class ShuffleOrder(Order):
    """Draw views of the finest size twice as often as other views: 40, 20, 20, and 20 % of the steps for four sizes
    (Barron et al. 2021, whose protocol Mip-Splatting follows)."""

    type: Literal["shuffle"] = "shuffle"

    def view_at(self, pool: ViewPool, step: int) -> View:
        return pool.shuffled_view([*range(len(pool.views)), *pool.finest], step)


class StackOrder(Order):
    """Draw a random view of the finest size in 30 % of the steps, and of any size in the others (Mip-Splatting).

    With four sizes, the finest gets 47.5 % of the steps, and each of the others 17.5 %.
    """

    type: Literal["stack"] = "stack"

    def view_at(self, pool: ViewPool, step: int) -> View:
        rng = pool.rng(step)
        if rng.random() < FINEST_FRACTION:
            return pool.views[pool.finest[int(rng.integers(len(pool.finest)))]]
        return pool.shuffled_view(range(len(pool.views)), step)


LOG = logging.getLogger("clsplat")


class ViewSettings(Settings):
    """The view of each training step, its size, and the transforms of its photograph."""

    order: OneOf[Order] = Uniform()
    """Order in which training visits the views."""
    resolution: Annotated[DetailDivisor | AtLeastOne, explain_schedule(", or {follows: detail, until, …}")] = 1.0
    """Downscale factor on top of `scene.downscale`, at least 1; may be scheduled, or follow the photos' detail."""
    transforms: list[OneOf[PhotographTransform]] = Field(default=[])
    """Transforms of the photo, in order."""

    def resolve(self, photographs: Callable[[], Iterable[NDArray[np.uint8]]]) -> "ViewSettings":
        """Return settings in which the resolution is a schedule.

        photographs: a function that returns the training photographs, each [height, width, 3].
        """
        if not isinstance(self.resolution, DetailDivisor):
            return self
        resolution = self.resolution.to_schedule(photographs())
        LOG.info(describe_sizes(resolution))
        return self.model_copy(update={"resolution": resolution})

    def divisor(self, step: int) -> float:
        """Return the downscale factor at a global step.  Raises ConfigError if `resolve` was not called."""
        if isinstance(self.resolution, DetailDivisor):
            raise ConfigError("`resolution: {follows: detail}` needs photos; call `resolve` first")
        return at_step(self.resolution, step)

    @property
    def changes(self) -> list[float]:
        """The global steps between which the downscale factor is constant or linear; empty if it is always constant."""
        resolution = self.resolution
        if isinstance(resolution, DetailDivisor):
            return [float(step) for step in resolution.changes]
        points = resolution.points if isinstance(resolution, Points) else resolution
        return [step for step, _ in points] if isinstance(points, list) else []

    @property
    def last_change(self) -> float:
        """The latest global step at which the size may change; 0 if it never changes."""
        return self.resolution.until if isinstance(self.resolution, DetailDivisor) else max([0.0, *self.changes])

    def first_large_step(self, last: int) -> int:
        """Return the first step with photographs larger than half their full size, or `last` if there is none."""
        return next((step for step in range(1, last + 1) if self.divisor(step) < 2), last)


@dataclass(frozen=True)
class Sample:
    """The sample of a training step."""

    view: View  # at the size of the step
    original: View  # at full training size
    index: int  # of the view among the training views
    transforms: Sequence[PhotographTransform]
    step: int  # global


class Sampler:
    """The samples of all steps.  Each depends only on the views, the settings, the seed, and the step."""

    def __init__(self, views: Sequence[View], settings: ViewSettings, seed: int) -> None:
        self.settings, self._pool = settings, ViewPool(views, seed)
        self._indices = {id(view): index for index, view in enumerate(views)}

    def at(self, step: int) -> Sample:
        """Return the sample of a global step, counted from 1."""
        view, divisor = self.settings.order.view_at(self._pool, step), self.settings.divisor(step)
        resized_view = view.resized(view.downscale * divisor)
        return Sample(resized_view, view, self._indices[id(view)], self.settings.transforms, step)
