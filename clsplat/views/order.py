"""The view of each training step, a function of the seed and the step alone: a resumed run goes on with the same."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import View

Sampling = Literal["uniform", "paper", "code"]
FULL_SHARE = 0.3  # of the steps, `code` overrides the order by a view of the finest scale


class ViewOrder:
    """All training views in a random order, then all in another; they may come at several scales.

    `uniform` shows every view of every scale equally often.  `paper` shows those of the finest scale twice as often
    as the others: 40, 20, 20, 20 % for four scales (Barron et al. 2021, whose protocol Mip-Splatting follows).
    `code` puts a random view of the finest scale in the place of 30 % of the steps: 47.5, 17.5, 17.5, 17.5 %, as the
    released code of Mip-Splatting does.
    """

    def __init__(self, views: Sequence[View], sampling: Sampling, seed: int) -> None:
        self.views, self.sampling, self.seed = views, sampling, seed
        finest = min(view.downscale for view in views)
        self._full = [i for i, view in enumerate(views) if view.downscale == finest]
        self._entries = [*range(len(views)), *(self._full if sampling == "paper" else [])]
        self._epoch, self._order = -1, np.empty(0, np.int64)

    def at(self, step: int) -> View:
        """Return the view of a step, counted from 1."""
        if self.sampling == "code":
            rng = np.random.default_rng([self.seed, step, len(self.views)])
            if rng.random() < FULL_SHARE:
                return self.views[self._full[int(rng.integers(len(self._full)))]]
        epoch, place = divmod(step - 1, len(self._entries))
        entry: int = self._entries[int(self._shuffled(epoch)[place])]
        return self.views[entry]

    def _shuffled(self, epoch: int) -> NDArray[Any]:
        if self._epoch != epoch:
            self._epoch = epoch
            self._order = np.random.default_rng([self.seed, epoch]).permutation(len(self._entries))
        return self._order
