"""The Gaussians in a part of space, without the others."""

import logging
from dataclasses import asdict
from typing import ClassVar, Literal

import numpy as np

from clsplat.density.box import Box
from clsplat.density.contribution import keep
from clsplat.errors import NoneInsideError
from clsplat.stages.base import Stage
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Crop(Stage):
    """Remove the Gaussians whose means lie outside a box."""

    stage: Literal["crop"] = "crop"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    inside: Box
    """The part of space that stays."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        kept = np.flatnonzero(self.inside.holds(gaussians.get("means")))
        if not len(kept):
            raise NoneInsideError(f"crop: none of {gaussians.count:,} Gaussians lies inside; expected a larger box")
        change = keep(gaussians, kept, self.stage)
        run.refresh_filter()
        run.records.add(run.step, "densify", **asdict(change))
        LOG.info("%s Gaussians kept, which lie inside", f"{change.after:,} of {change.before:,}")
