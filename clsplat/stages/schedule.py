"""The small scheduled changes of the model."""

from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.density.control import cap_opacity
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run


class RaiseSh(Scheduled):
    """Let the colours use one more band of spherical harmonics."""

    stage: Literal["raise_sh"] = "raise_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        model = run.model
        model.degree = min(model.degree + 1, model.gaussians.sh_degree)


class ResetOpacity(Scheduled):
    """Make every Gaussian almost transparent; those that are needed come back, floaters do not (Kerbl et al. 2023).

    `to` is the opacity after the world filter (Yu et al. 2024).
    """

    stage: Literal["reset_opacity"] = "reset_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    to: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Largest opacity afterwards."""
    when_background: Literal["black", "white"] | None = None
    """Background on which the stage acts; without it, on both."""

    def stale(self, run: Run) -> Collection[str]:
        return ("logit_opacity",) if self._acts(run) else ()

    def run(self, run: Run) -> None:
        if not self._acts(run):
            return
        cap_opacity(run.model.gaussians, self.to)
        if run.adam is not None:
            run.adam.forget("logit_opacity")

    def _acts(self, run: Run) -> bool:
        return self.when_background in (None, run.photographs.background_name)


class RefreshFilter(Scheduled):
    """Let the world filter, and the sampling intervals that sizes in pixels go by, follow the Gaussians as they move.

    They also do so when Gaussians are made and after every density edit; a model that has neither has nothing to do.
    """

    stage: Literal["refresh_filter"] = "refresh_filter"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        run.refresh_filter()
