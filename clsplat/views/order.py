"""The view of each training step: it depends on the seed and the step alone, so a resumed run uses the same views."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import View
from clsplat.settings import Settings

FINEST_SHARE = 0.3  # of the steps, which use a random view of the finest size (released code of Mip-Splatting)


class ViewPool:
    """The training views, which may come at several sizes, and permutations of them."""

    def __init__(self, views: Sequence[View], seed: int) -> None:
        finest = min(view.downscale for view in views)
        self.views, self.seed = views, seed
        self.finest = [i for i, view in enumerate(views) if view.downscale == finest]  # indices into `views`
        self._epoch, self._permutation = (-1, -1), np.empty(0, np.int64)

    def shuffled(self, entries: Sequence[int], step: int) -> View:
        """Return the view of a step; each pass uses all `entries`, indices into `views`, in a new order."""
        epoch, place = divmod(step - 1, len(entries))
        return self.views[entries[int(self._shuffle(epoch, len(entries))[place])]]

    def random(self, step: int) -> np.random.Generator:
        """Return random numbers that depend on the seed and the step alone."""
        return np.random.default_rng([self.seed, step, len(self.views)])

    def _shuffle(self, epoch: int, count: int) -> NDArray[Any]:
        if self._epoch != (epoch, count):
            self._epoch = epoch, count
            self._permutation = np.random.default_rng([self.seed, epoch]).permutation(count)
        return self._permutation


class Order(Settings):
    """Which view a step trains on."""

    @abstractmethod
    def at(self, pool: ViewPool, step: int) -> View:
        """Return the view of a step, counted from 1; it may depend on the pool, its seed and the step only."""


class Uniform(Order):
    """All views of every size, in a new random order in each pass."""

    type: Literal["uniform"] = "uniform"

    def at(self, pool: ViewPool, step: int) -> View:
        return pool.shuffled(range(len(pool.views)), step)


class Paper(Order):
    """Views of the finest size twice as often as the others: 40, 20, 20, 20 % for four sizes (Barron et al. 2021, whose
    protocol Mip-Splatting follows)."""

    type: Literal["paper"] = "paper"

    def at(self, pool: ViewPool, step: int) -> View:
        return pool.shuffled([*range(len(pool.views)), *pool.finest], step)


class Code(Order):
    """A random view of the finest size in the place of 30 % of the steps: 47.5, 17.5, 17.5, 17.5 % for four sizes (the
    released code of Mip-Splatting)."""

    type: Literal["code"] = "code"

    def at(self, pool: ViewPool, step: int) -> View:
        rng = pool.random(step)
        if rng.random() < FINEST_SHARE:
            return pool.views[pool.finest[int(rng.integers(len(pool.finest)))]]
        return pool.shuffled(range(len(pool.views)), step)
