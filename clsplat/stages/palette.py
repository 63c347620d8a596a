"""A palette of harmonics, as a SOG holds it: drawn, and trained."""

import logging
from collections.abc import Collection
from functools import partial
from typing import ClassVar, Literal

from clsplat.errors import amount
from clsplat.formats.sog_writing import Harmonics
from clsplat.formats.splats import Writing
from clsplat.gaussians import members
from clsplat.gaussians.clusters import DeviceClusters
from clsplat.stages.base import Scheduled
from clsplat.stages.reduction import scores
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class PaletteSh(Scheduled):
    """Give each Gaussian one of the vectors of a palette of harmonics, as a SOG holds them.

    Errors count by what a Gaussian contributes to the training views.  Training that follows with a rate of 0 for
    `sh_rest` adapts the other tables to them, and the SOG then loses nothing of its harmonics.  Harmonics that are
    vectors of a palette already keep it, and are rounded to the numbers that a SOG has.
    """

    stage: Literal["palette_sh"] = "palette_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"palette"})
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
        options, score = Writing(quality=self.quality, clustering=partial(DeviceClusters, run.device)), scores(run)
        found = Harmonics.of(gaussians.get("sh_rest"), options, score)
        gaussians.set("sh_rest", found.values)
        members.set_clusters(gaussians, found.labels, score)
        if run.adam is not None:
            run.adam.forget("sh_rest")
        LOG.info("%s of %s", amount(len(found.palette), "harmonic"), amount(gaussians.count, "Gaussian"))


class SharePalette(Scheduled):
    """Move each vector of the palette to the mean of the harmonics of its Gaussians, which get it again.

    The mean is by what the Gaussians contributed to the training views when `palette_sh` drew the palette.  On a
    cadence, with a rate for `sh_rest`, the vectors are trained: each Gaussian moves its own, and those that share one
    agree.  It belongs right behind such a training too, since no edit follows the last step.
    """

    stage: Literal["share_palette"] = "share_palette"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "palette"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        if run.model.gaussians.sh_degree:
            members.share(run.model.gaussians, "sh_rest")
