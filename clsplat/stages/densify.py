"""Density control on a cadence."""

import logging
from collections.abc import Collection
from typing import ClassVar, Literal

from clsplat.errors import NumericError
from clsplat.gaussians.model import PARAMETERS
from clsplat.stages.base import Stage
from clsplat.training.density import AnyRule, densify
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Densify(Stage):
    """Apply rules that clone, split and prune Gaussians, as one rearrangement of all tables."""

    stage: Literal["densify"] = "densify"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "stats"})
    edits: ClassVar[bool] = True

    rules: list[AnyRule]

    def stale(self, run: Run) -> Collection[str]:
        return PARAMETERS

    def run(self, run: Run) -> None:
        if run.stats is None:
            return
        gaussians = run.trained.gaussians
        change = densify(gaussians, run.stats, self.rules, run.renderer.tiler, run.scene.extent, run.step, run.seed)
        run.refresh_filter()
        run.records.add(run.step, "densify", before=change.before, after=change.after)
        LOG.debug("step %d: %d -> %d Gaussians", run.step, change.before, change.after)
        if change.after == 0:
            raise NumericError(f"step {run.step}: every Gaussian was pruned; weaken the prune rules or lower the rates")
