"""Density control on a cadence."""

import logging
from collections.abc import Collection
from dataclasses import asdict
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.density.edit import SceneScale, densify
from clsplat.density.rules import AnyRule
from clsplat.errors import NumericError
from clsplat.gaussians.tables import PARAMETERS
from clsplat.stages.base import Stage
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Densify(Stage):
    """Apply rules that clone, split and prune Gaussians, as one rearrangement of all tables."""

    stage: Literal["densify"] = "densify"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "stats"})
    edits: ClassVar[bool] = True

    rules: list[AnyRule]
    max_gaussians: Annotated[int, Field(gt=0)] | None = None  # growth stops here, or where memory ends; pruning goes on

    @property
    def statistics(self) -> set[str]:
        """Columns that the rules read."""
        return {name for rule in self.rules for name in rule.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rules read beside the parameters."""
        return {name for rule in self.rules for name in rule.tables}

    def stale(self, run: Run) -> Collection[str]:
        return PARAMETERS

    def run(self, run: Run) -> None:
        if run.stats is None:
            return
        gaussians = run.trained.gaussians
        measures = SceneScale(run.scene.extent, run.texture_quantile)
        tiler = run.rasterizer.tiler
        fits = run.memory_plan().most
        most = min(fits, self.max_gaussians or fits)
        change = densify(gaussians, run.stats, self.rules, tiler, measures, run.step, run.seed, most)
        run.refresh_filter()
        if change.after == fits:
            LOG.warning("step %d: growth stops at %d Gaussians, all that fit in the device's memory", run.step, fits)
        run.records.add(run.step, "densify", **asdict(change))
        LOG.debug("step %d: %d -> %d Gaussians", run.step, change.before, change.after)
        if change.after == 0:
            raise NumericError(f"step {run.step}: every Gaussian was pruned; weaken the prune rules or lower the rates")
