"""A density rule and a stage: `rules: [..., prune_at_random]` and `during: [..., {cap_size: {every: 100}}]`."""

from typing import ClassVar, Literal

import numpy as np

from clsplat.plugin import Edit, Positive, Rule, Run, Scheduled, at_step


class PruneAtRandom(Rule):
    """Remove a random fraction of the faint Gaussians."""

    type: Literal["prune_at_random"] = "prune_at_random"
    fraction: Positive = 0.5
    """Fraction of the faint Gaussians to remove; may be scheduled."""
    opacity_below: Positive = 0.1
    """Opacity below which a Gaussian is faint; may be scheduled."""

    def mark(self, edit: Edit) -> None:
        opacity = 1 / (1 + np.exp(-edit.gaussians.get("logit_opacity")[:, 0]))
        is_faint = opacity < edit.evaluate(self.opacity_below)
        is_drawn = edit.random().random(len(is_faint)) < edit.evaluate(self.fraction)
        edit.choose(is_faint & is_drawn, copies=0, old_rows=0)


class CapSize(Scheduled):
    """Shrink Gaussians that are larger than a fraction of the scene extent."""

    stage: Literal["cap_size"] = "cap_size"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    max_size: Positive = 0.1
    """Largest standard deviation along an axis, as a fraction of the extent; may be scheduled."""

    def run(self, run: Run) -> None:
        log_scales = run.model.gaussians.get("log_scales")
        max_log_scale = np.log(at_step(self.max_size, run.step) * run.scene.extent)
        run.model.gaussians.set("log_scales", np.minimum(log_scales, max_log_scale).astype(np.float32))
