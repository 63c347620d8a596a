"""Small changes of the model at a cadence."""

from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from clsplat.density.control import cap_opacity, decay_opacity
from clsplat.schedule import Bounded, Positive, at_step
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run


class RaiseSh(Scheduled):
    """Add one band of spherical harmonics to the colours."""

    stage: Literal["raise_sh"] = "raise_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        model = run.model
        model.degree = min(model.degree + 1, model.gaussians.sh_degree)


class ResetOpacity(Scheduled):
    """Lower all opacities; training raises those of needed Gaussians, and pruning removes floaters (Kerbl et al. 2023).

    `to` holds after the world filter (Yu et al. 2024).
    """

    stage: Literal["reset_opacity"] = "reset_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"to"})

    to: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Largest opacity after the reset."""
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


class DecayOpacity(Scheduled):
    """Lower all opacities a little, in the place of a reset; training raises those of needed Gaussians (Binocular3DGS,
    Han et al. 2024).

    Published is a factor of 0.995 at each step, for 3 to 8 photographs.  Ours is one for each pass over the training
    photographs: among many a Gaussian is seen as often, not more rarely, while its opacity falls as much.
    """

    stage: Literal["decay_opacity"] = "decay_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"per_pass"})

    per_pass: Annotated[Positive, AfterValidator(Bounded(0, most=1))] = 0.975
    """Factor of the opacities in as many steps as there are training photographs; 1 changes nothing; by step."""

    def run(self, run: Run) -> None:
        factor = at_step(self.per_pass, run.step) ** ((self.every or 1) / len(run.scene.split("train")))
        if factor < 1:
            decay_opacity(run.model.gaussians, factor)


class RefreshFilter(Scheduled):
    """Update the world filter and the sampling intervals, which sizes in pixels depend on, to the present means.

    `init` and every density edit update them too.  For a model without both, the stage has no effect.
    """

    stage: Literal["refresh_filter"] = "refresh_filter"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        run.refresh_filter()
