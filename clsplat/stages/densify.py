"""Apply density rules at a cadence."""

import logging
import math
from collections.abc import Collection, Iterator
from dataclasses import asdict
from functools import partial
from typing import Annotated, ClassVar, Literal

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
from clsplat.training.sh_offload import device_capacity, make_room, offload_advice
from clsplat.training.stage import Scheduled

LOG = logging.getLogger("clsplat")


class Densify(Scheduled):
    """Apply rules that clone, split and prune Gaussians, as one rearrangement of all tables."""

    stage: Literal["densify"] = "densify"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "stats"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"max_gaussians", "patience", "grow_until"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"grow_until"})

    rules: list[OneOf[Rule]]
    """Rules that grow or remove Gaussians.  The first growth rule that selects a Gaussian applies; pruning rules take
    precedence."""
    max_gaussians: AtLeastOne | None = None
    """Number of Gaussians at which growth stops; pruning continues.  Default: as many as fit in memory.  With `inside`,
    only Gaussians in the box count."""
    budget: OneOf[Budget] | None = None
    """Limit of the growth of each edit, which depends on the progress of training; needs `stop`."""

    inside: Box | None = None
    """Box in which Gaussians grow; Gaussians outside are trained and pruned.  Default: everywhere."""

    patience: Annotated[int, Field(gt=0)] | None = None
    """Number of consecutive measurements of the validation views without improvement after which growth ends; pruning
    continues, and the `patience` of the training counts from zero again.  Needs `keep: best`.  Default: growth does
    not end."""
    grow_until: Annotated[int, Field(gt=0)] | None = None
    """Global step at which growth ends; pruning continues.  Default: growth does not end."""

    @property
    def statistics(self) -> set[str]:
        """The columns of statistics that the rules read."""
        return {name for source in (*self.rules, self.budget) if source for name in source.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rules read in addition to the parameters."""
        return {name for rule in self.rules for name in rule.tables}

    @model_validator(mode="after")
    def _require_known_statistics(self) -> "Densify":
        statistics = variants(Statistic)
        for rule in self.rules:
            if unknown := sorted(rule.statistics - statistics.keys()):
                name = getattr(rule, "type", type(rule).__name__)
                raise ValueError(
                    f"the rule '{name}' reads an unknown statistic '{unknown[0]}'; expected {', '.join(statistics)}"
                )
        return self

    @model_validator(mode="after")
    def _require_stop(self) -> "Densify":
        if self.budget and self.stop is None:
            raise ValueError("'budget' needs 'stop', the step at which the budget is reached")
        return self

    def frozen_parameters(self, run: Run) -> Collection[str]:
        return run.model.gaussians.trained

    def run(self, run: Run) -> None:
        if run.stats is None:
            return
        scale = SceneScale(run.scene.extent, run.compute_texture_quantile)
        edit = Edit(run.model.gaussians, run.stats, scale, run.step, run.seed, run.survey())
        limit_by_settings = min(self._limits(run, edit), default=math.inf)
        capacity = device_capacity(run, limit_by_settings)
        limit = int(min(capacity, limit_by_settings))
        room = partial(make_room, run)
        change = densify(edit, self.rules, run.rasterizer.tiler, limit, self._box(run), room)
        run.refresh_filter()
        if change.after == capacity:
            remedy = f"smaller photos{offload_advice(run)} leave room for more"
            limit_text = f"{capacity:,} Gaussians, the most that fit in the device's memory; {remedy}"
            LOG.warning("step %d: growth stops at %s", run.step, limit_text)
        run.records.add(run.step, "densify", **asdict(change))
        LOG.debug("step %d: %s -> %s", run.step, f"{change.before:,}", pluralize(change.after, "Gaussian"))
        if change.after == 0:
            remedy = "relax the prune rules, or lower the learning rates"
            raise NumericError(f"step {run.step}: all Gaussians were pruned; {remedy}")

    def _has_growth_ended(self, run: Run) -> bool:
        """Return whether growth has ended.  If `patience` ends growth at this step, record the step in the run."""
        if self.grow_until is not None and run.step >= self.grow_until:
            return True
        best = run.best
        if self.patience is None or best is None or run.is_refit:  # a refit has the step in its pipeline
            return False
        if best.growth_ended is None and best.since_best >= self.patience:
            best = run.best = best.model_copy(update={"growth_ended": run.step, "since_best": 0})
            LOG.info("step %d: growth ends; the model was best at step %d", run.step, best.measured.step)
        return best.growth_ended is not None

    def _box(self, run: Run) -> Box | None:
        """Return the box in which Gaussians grow, in the run's coordinates."""
        return self.inside and self.inside.shifted(run.scene.origin)

    def _count_outside(self, run: Run, edit: Edit) -> int:
        """Return the number of Gaussians outside the box in which Gaussians grow."""
        box = self._box(run)
        return int((~box.contains(edit.gaussians.get("means"))).sum()) if box else 0

    def _limits(self, run: Run, edit: Edit) -> Iterator[int]:
        """Yield each number of Gaussians at which a setting stops growth."""
        if self._has_growth_ended(run):
            yield 0
        if self.max_gaussians is not None:
            yield int(edit.evaluate(self.max_gaussians)) + self._count_outside(run, edit)
        if self.budget and self.every and self.stop:
            edits = len(fire_steps(self.every, run.step - 1, self.stop))
            context = BudgetContext(run.step / self.stop, edits, run.image_downscale)
            yield self.budget.limit(edit, context, run.scalars)
