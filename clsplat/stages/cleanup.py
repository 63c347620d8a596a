"""Rules that remove Gaussians, applied once: behind a training, or between two."""

import logging
from dataclasses import asdict
from typing import ClassVar, Literal

from pydantic import Field, field_validator

from clsplat.density.basic import PruneFaint
from clsplat.density.control import apply_marks, mark
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import PruneUseless
from clsplat.density.outliers import PruneFar
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.errors import NumericError
from clsplat.settings import OneOf
from clsplat.stages.base import Stage
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Cleanup(Stage):
    """Remove what a trained model has and the training photographs hardly show, which is seen from other places.

    All rules see the model as it is before.  What two of them remove counts for the first.
    """

    stage: Literal["cleanup"] = "cleanup"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    takes: ClassVar[frozenset[str]] = frozenset({"stats"})
    edits: ClassVar[bool] = True
    changes_last: ClassVar[bool] = True

    rules: list[OneOf[Rule]] = Field(
        [PruneFaint(opacity_below=0.02), PruneFar(), PruneUseless(views_below=0)], min_length=1
    )
    """Which Gaussians are removed, each rule with its keys; a rule that is not in the list removes none.
    `prune_useless` with `views_below: 2` removes those that are useful in one photograph alone, too; `prune_wide` those
    that are large on the screen."""

    @field_validator("rules")
    @classmethod
    def _that_remove(cls, rules: list[Rule]) -> list[Rule]:
        for rule in rules:
            name = getattr(rule, "type", "rule")
            if rule.grows:
                raise ValueError(f"the rule '{name}' is of growth; expected rules that remove, such as prune_faint")
            if rule.rewrites:
                raise ValueError(f"the rule '{name}' changes Gaussians that stay; use it in densify")
            if rule.start:
                raise ValueError(f"the rule '{name}' has a start, and cleanup applies it once; expected start: 0")
            if read := sorted(rule.statistics | rule.tables):
                raise ValueError(f"the rule '{name}' reads {', '.join(read)} of training steps; use it in densify")
        return rules

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        run.stats = SplatStats(gaussians, ())  # sums over steps are not of the Gaussians that follow
        scale = SceneScale(run.scene.extent, run.texture_quantile)
        step = max(run.step, 1)  # rules act after step 0
        edit = Edit(gaussians, run.stats, scale, step, run.seed, run.survey())
        edit.may_rewrite = False  # what refuses leaves the model as it was
        change = mark(edit, self.rules)
        if change.after == 0:
            raise NumericError(
                "cleanup: its rules would remove every Gaussian; weaken them, as with a smaller "
                "prune_faint.opacity_below, or remove the stage"
            )
        with run.changing():
            apply_marks(edit, run.rasterizer.tiler)
            run.refresh_filter()
        run.records.add(run.step, "densify", **asdict(change))
        removed = ", ".join(f"{name} {number:,}" for name, number in change.causes.items())
        LOG.info("%s Gaussians kept; removed: %s", f"{change.after:,} of {change.before:,}", removed)
