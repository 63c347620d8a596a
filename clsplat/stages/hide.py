"""What a training view need not draw."""

from typing import ClassVar, Literal

from clsplat.density.importance import useless
from clsplat.density.thresholds import Share
from clsplat.gaussians.left_out import HIDDEN_VIEWS, hide
from clsplat.gaussians.tables import HIDDEN
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run


class HideUseless(Scheduled):
    """Leave out of the steps on each training view the Gaussians that make little of it, which saves time
    (Mini-Splatting2, Fang and Wang 2024).

    Useful in a view are those that make most of its weight, alpha T over all pixels, the largest first.  What is new
    later is hidden where its source was.  All are drawn in other pictures, and in all after the training.
    """

    stage: Literal["hide_useless"] = "hide_useless"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"of_view"})
    edits: ClassVar[bool] = True

    of_view: Share = 0.99
    """Share of a view's weight that is made by what it shows."""

    def attach(self, run: Run) -> None:
        if HIDDEN not in run.model.gaussians.tables:
            run.model.gaussians.add(HIDDEN, -(-len(run.scene.split("train")) // HIDDEN_VIEWS))

    def run(self, run: Run) -> None:
        hide(run.model.gaussians, useless(run.survey(), self.of_view))
