"""Bring the tables of a model to the values that a format can hold, so that what is trained after that knows them."""

import logging
from collections.abc import Collection
from functools import partial
from typing import ClassVar, Literal

from clsplat.formats.sog_writing import Harmonics
from clsplat.formats.splats import Writing
from clsplat.gaussians.clusters import DeviceClusters
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class PaletteSh(Scheduled):
    """Give each Gaussian the harmonics that a SOG would hold for it: one of the vectors of a palette.

    Training that follows with a rate of 0 for `sh_rest` adapts the other tables to them, and the SOG then loses nothing
    of its harmonics.
    """

    stage: Literal["palette_sh"] = "palette_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"quality"})

    quality: Literal["small", "balanced", "high"] = "balanced"
    """Of the SOG: `small`, `balanced` or `high`, which have 1,024, 4,096 and 16,384 vectors at most."""

    def stale(self, run: Run) -> Collection[str]:
        return ("sh_rest",)

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        if not gaussians.sh_degree:
            return
        options = Writing(quality=self.quality, clustering=partial(DeviceClusters, run.device))
        found = Harmonics.of(gaussians.get("sh_rest"), options)
        gaussians.set("sh_rest", found.values)
        if run.adam is not None:
            run.adam.forget("sh_rest")
        LOG.info("%d harmonics of %d Gaussians", len(found.palette), gaussians.count)
