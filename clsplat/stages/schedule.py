"""Change the model periodically: SH degree, opacities, the filter, and averages of the parameters."""

import logging
from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.density.control import cap_opacity
from clsplat.training import adam
from clsplat.training.run import Run
from clsplat.training.stage import ALL_HARMONICS, Scheduled

LOG = logging.getLogger("clsplat")


class RaiseSh(Scheduled):
    """Raise the active SH degree by one."""

    stage: Literal["raise_sh"] = "raise_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        model = run.model
        model.degree = min(model.degree + 1, model.gaussians.sh_degree)


class ResetOpacity(Scheduled):
    """Lower all opacities.  Training raises them where needed, and pruning removes floaters (Kerbl et al. 2023).

    `value` limits the opacities after the world filter (Yu et al. 2024).
    """

    stage: Literal["reset_opacity"] = "reset_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"value"})

    value: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Largest opacity after the reset."""
    when_background: Literal["black", "white"] | None = None
    """Background color for which the stage has an effect; default: any."""

    def frozen_parameters(self, run: Run) -> Collection[str]:
        return ("logit_opacity",) if self._is_active(run) else ()

    def run(self, run: Run) -> None:
        if not self._is_active(run):
            return
        cap_opacity(run.model.gaussians, self.value)
        if run.adam is not None:
            run.adam.reset_moments("logit_opacity")

    def _is_active(self, run: Run) -> bool:
        return self.when_background in (None, run.photographs.background_name)


class RefreshFilter(Scheduled):
    """Update the world filter, and the sampling intervals that sizes in pixels depend on, to the current means.

    `init` and every density edit update them too.  Without a filter or sizes in pixels, the stage has no effect.
    """

    stage: Literal["refresh_filter"] = "refresh_filter"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        run.refresh_filter()


class AverageParameters(Scheduled):
    """Average every parameter over the steps at which this stage runs (Polyak and Juditsky 1992).

    While learning rates are large, the parameters oscillate around a better model, which their average approaches.
    Training continues from the parameters; the average replaces them after the last step.  A new Gaussian is averaged
    from its creation on.  Edits of existing Gaussians, such as a reset of opacities, are averaged with the earlier
    values, so set `start` to a step after these edits.
    """

    stage: Literal["average"] = "average"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    conflicts = ALL_HARMONICS

    def attach(self, run: Run) -> None:
        adam.attach_average(run.model.gaussians)

    def run(self, run: Run) -> None:
        self.attach(run)
        adam.add_to_average(run.model.gaussians)

    def finish(self, run: Run) -> None:
        if adam.has_average(run.model.gaussians):  # a resumed run may have replaced the parameters before
            if not any(map(self.is_due, range(run.step - run.stage_step + 1, run.step))):  # no edit after the last step
                LOG.info("average: training ended before averaging started; the model is that of the last step")
            with run.editing_tables():
                adam.apply_average(run.model.gaussians)
                run.refresh_filter()
