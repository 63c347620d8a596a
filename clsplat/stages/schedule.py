"""Small changes of the model at a cadence: harmonics, opacities, the filter, and averages of the parameters."""

from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.density.control import cap_opacity
from clsplat.training import adam
from clsplat.training.run import Run
from clsplat.training.stage import ALL_HARMONICS, Scheduled, Stage


class RaiseSh(Scheduled):
    """Add one band of spherical harmonics to the colors."""

    stage: Literal["raise_sh"] = "raise_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        model = run.model
        model.degree = min(model.degree + 1, model.gaussians.sh_degree)


class ResetOpacity(Scheduled):
    """Lower all opacities; training raises those of needed Gaussians, and pruning removes floaters (Kerbl et al. 2023).

    `value` holds after the world filter (Yu et al. 2024).
    """

    stage: Literal["reset_opacity"] = "reset_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"value"})

    value: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Largest opacity after the reset."""
    when_background: Literal["black", "white"] | None = None
    """Background on which the stage acts; without it, on both."""

    def stale(self, run: Run) -> Collection[str]:
        return ("logit_opacity",) if self._acts(run) else ()

    def run(self, run: Run) -> None:
        if not self._acts(run):
            return
        cap_opacity(run.model.gaussians, self.value)
        if run.adam is not None:
            run.adam.forget("logit_opacity")

    def _acts(self, run: Run) -> bool:
        return self.when_background in (None, run.photographs.background_name)


class RefreshFilter(Scheduled):
    """Update the world filter and the sampling intervals, which sizes in pixels depend on, to the present means.

    `init` and every density edit update them too.  For a model without both, the stage has no effect.
    """

    stage: Literal["refresh_filter"] = "refresh_filter"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        run.refresh_filter()


# The average of the Gaussians over the last steps of a training, instead of those of the last step.


class AddToAverage(Scheduled):
    """Add every parameter to its average over the steps at which this stage runs (Polyak and Juditsky 1992).

    Training goes on from the parameters themselves.  A Gaussian that is new has an average since then.  What an edit
    changes in Gaussians that stay, such as a reset of opacities, is averaged with what was before: `start` belongs
    after those.
    """

    stage: Literal["add_to_average"] = "add_to_average"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"average"})
    edits: ClassVar[bool] = True
    conflicts = ALL_HARMONICS

    def attach(self, run: Run) -> None:
        adam.attach(run.model.gaussians)

    def run(self, run: Run) -> None:
        self.attach(run)
        adam.add(run.model.gaussians)


class TakeAverage(Stage):
    """Replace the parameters by their averages; it belongs right behind the training.

    Steps that jump about a good model, at learning rates that are still large, lie around one that is better.
    """

    stage: Literal["take_average"] = "take_average"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "average"})
    takes: ClassVar[frozenset[str]] = frozenset({"average"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        adam.take(run.model.gaussians)
        run.refresh_filter()
