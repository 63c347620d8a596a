"""Density control at a cadence."""

import logging
import math
from collections.abc import Collection, Iterator
from dataclasses import asdict
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from clsplat.core.errors import NumericError, pluralize
from clsplat.core.schedule import AtLeastOne, fire_steps
from clsplat.core.settings import OneOf, variants
from clsplat.density.budget import Budget, BudgetContext
from clsplat.density.control import Box, densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import Statistic
from clsplat.density.thresholds import SceneScale
from clsplat.training.run import Run
from clsplat.training.sh_offload import make_room, more_room, most_gaussians
from clsplat.training.stage import Scheduled

LOG = logging.getLogger("clsplat")


class Densify(Scheduled):
    """Apply rules that clone, split and prune Gaussians, as one rearrangement of all tables."""

    stage: Literal["densify"] = "densify"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "stats"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"max_gaussians", "per_pixel", "patience", "grow_until"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"grow_until"})

    rules: list[OneOf[Rule]]
    """Which Gaussians grow or are removed; the first growing rule decides, pruning rules override growth."""
    max_gaussians: AtLeastOne | None = None
    """Number of Gaussians at which growth stops, by step; without it, as many as fit in memory.  Pruning continues.
    With `inside` it is the number of those in there."""
    per_pixel: Annotated[float, Field(gt=0)] | None = None
    """Number of Gaussians at which growth stops, for each pixel of a training photograph (the median of them); without
    it, no such number.  Pruning continues.  `inside` as above."""
    budget: OneOf[Budget] | None = None
    """Number of Gaussians at which the growth of an edit stops, from the course of the training; needs `stop`."""

    inside: Box | None = None
    """Part of space in which Gaussians grow; those outside train and are pruned.  Without it, all space."""

    patience: Annotated[int, Field(gt=0)] | None = None
    """Measurements of the validation views in a row without a better one after which nothing grows any more, in a
    training with `keep: best`, whose own patience counts anew from there; pruning continues.  Without it, growth goes
    on."""
    grow_until: Annotated[int, Field(gt=0)] | None = None
    """Global step from which on nothing grows; pruning continues.  Without it, growth goes on."""

    @property
    def statistics(self) -> set[str]:
        """Columns of statistics that the rules read."""
        return {name for part in (*self.rules, self.budget) if part for name in part.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rules read beside the parameters."""
        return {name for rule in self.rules for name in rule.tables}

    @model_validator(mode="after")
    def _with_known_statistics(self) -> "Densify":
        known = variants(Statistic)
        for rule in self.rules:
            if unknown := sorted(rule.statistics - known.keys()):
                name = getattr(rule, "type", type(rule).__name__)
                raise ValueError(
                    f"the rule '{name}' reads an unknown statistic '{unknown[0]}'; expected {', '.join(known)}"
                )
        return self

    @model_validator(mode="after")
    def _with_an_end(self) -> "Densify":
        if self.budget and self.stop is None:
            raise ValueError("'budget' needs 'stop', the step at which it is reached")
        return self

    @model_validator(mode="after")
    def _with_growth(self) -> "Densify":
        if self.per_pixel is not None and not any(rule.grows for rule in self.rules):
            raise ValueError(
                "'per_pixel' ends growth, and no rule here grows; set it to null, or beside rules that clone or split"
            )
        return self

    def stale(self, run: Run) -> Collection[str]:
        return run.model.gaussians.trained

    def run(self, run: Run) -> None:
        if run.stats is None:
            return
        scale = SceneScale(run.scene.extent, run.texture_quantile)
        edit = Edit(run.model.gaussians, run.stats, scale, run.step, run.seed, run.survey())
        asked = min(self._limits(run, edit), default=math.inf)
        fits = most_gaussians(run, asked)
        limit = int(min(fits, asked))
        room = partial(make_room, run)
        change = densify(edit, self.rules, run.rasterizer.tiler, limit, self.inside, room)
        run.refresh_filter()
        if change.after == fits:
            more = f"smaller photographs{more_room(run)}"
            most = f"{fits:,} Gaussians, the most that fit in the device's memory; with {more} more do"
            LOG.warning("step %d: growth stops at %s", run.step, most)
        run.records.add(run.step, "densify", **asdict(change))
        LOG.debug("step %d: %s -> %s", run.step, f"{change.before:,}", pluralize(change.after, "Gaussian"))
        if change.after == 0:
            raise NumericError(f"step {run.step}: every Gaussian was pruned; weaken the prune rules or lower the rates")

    def _has_grown(self, run: Run) -> bool:
        """Whether growth has ended, by its step or by validation; a run keeps the step."""
        if self.grow_until is not None and run.step >= self.grow_until:
            return True
        best = run.best
        if self.patience is None or best is None or run.is_refit:  # whose pipeline says the step
            return False
        if best.growth_ended is None and best.since_best >= self.patience:
            best = run.best = best.model_copy(update={"growth_ended": run.step, "since": 0})
            LOG.info("step %d: growth ends: the model was best at step %d", run.step, best.measured.step)
        return best.growth_ended is not None

    def _outside(self, edit: Edit) -> int:
        """The Gaussians outside the part of space in which they grow."""
        if self.inside is None:
            return 0
        return int((~self.inside.holds(edit.gaussians.get("means"))).sum())

    def _limits(self, run: Run, edit: Edit) -> Iterator[int]:
        """The numbers of Gaussians at which the settings stop growth."""
        if self._has_grown(run):
            yield 0
        if self.max_gaussians is not None:
            yield int(edit.at(self.max_gaussians)) + self._outside(edit)
        if self.per_pixel is not None:
            views = [view for view in run.scene.split("train") if view.downscale == run.downscale]
            sizes = [view.camera.width * view.camera.height for view in views]
            yield max(1, int(self.per_pixel * float(np.median(sizes)))) + self._outside(edit)
        if self.budget and self.every and self.stop:
            left = len(fire_steps(self.every, run.step - 1, self.stop))
            context = BudgetContext(run.step / self.stop, left, run.image_downscale)
            yield self.budget.limit(edit, context, run.scalars)
