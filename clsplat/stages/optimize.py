"""The training loop: render, compare, differentiate, update."""

import logging
import math
import time
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from clsplat.density.statistics import SplatStats
from clsplat.errors import Interrupted, NumericError
from clsplat.losses.image import L1, L2, Dssim, Loss, ViewGradients, pixel_loss
from clsplat.losses.penalties import Anisotropy, CovarianceTrace, Penalty
from clsplat.metrics.distribution import distribution
from clsplat.stages.base import Stage
from clsplat.stages.checkpoint import Checkpoint
from clsplat.stages.densify import Densify
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.export import Export
from clsplat.stages.schedule import RaiseSh, RefreshFilter, ResetOpacity
from clsplat.training import checkpoint
from clsplat.training.adam import Adam, Rates
from clsplat.training.profile import stage_milliseconds
from clsplat.training.run import Progress, Run
from clsplat.training.step import differentiate, update

LOG = logging.getLogger("clsplat")
DISTRIBUTION_EVERY = 5  # reports
Scheduled = Annotated[
    RaiseSh | Densify | ResetOpacity | RefreshFilter | Checkpoint | Evaluate | Export, Field(discriminator="stage")
]
AnyTerm = Annotated[L1 | L2 | Dssim | CovarianceTrace | Anisotropy, Field(discriminator="type")]


class Optimize(Stage):
    """Train for a number of steps, one view each (Kerbl et al. 2023).

    Stages in `during` that edit parameters act between a step and the next, so whatever else is due at that step sees
    what training has settled, and nothing is edited after the last step.  As in the reference, a gradient whose
    parameter is about to be edited is not applied.
    """

    stage: Literal["optimize"] = "optimize"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"adam", "stats"})

    steps: Annotated[int, Field(gt=0)]
    rates: Rates = Rates()
    losses: list[AnyTerm]
    during: list[Scheduled] = Field([])
    log_every: Annotated[int, Field(gt=0)] = 100  # steps between lines of metrics.jsonl

    @field_validator("losses")
    @classmethod
    def _of_an_image(cls, losses: list[AnyTerm]) -> list[AnyTerm]:
        if not any(isinstance(loss, Loss) for loss in losses):
            raise ValueError("expected at least one loss that compares images: l1, l2 or dssim")
        return losses

    @field_validator("during")
    @classmethod
    def _on_a_cadence(cls, during: list[Stage]) -> list[Stage]:
        for stage in during:
            if stage.every is None:
                raise ValueError(f"'{getattr(stage, 'stage', '')}' needs 'every' inside 'during'")
        return during

    def check(self) -> None:
        for stage in self.during:
            stage.check()

    def run(self, run: Run) -> None:
        model = run.trained
        run.adam = run.adam or Adam(model.gaussians)
        run.stats = SplatStats(model.gaussians, self.statistics)
        self._attach(run)
        memory = run.memory_plan()
        LOG.info(memory.text(model.gaussians.count))
        memory.check(model.gaussians.count)
        last_step = run.step - run.stage_step + self.steps
        seconds: list[float] = []  # of the steps since the last report
        while run.stage_step < self.steps:
            start = time.perf_counter()
            if run.stage_step > 0:
                self._edit(run)
            view = self._step(run)
            report = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            loss, psnr = self._values(run, view) if report else (0.0, 0.0)
            seconds.append(time.perf_counter() - start)
            run.train_seconds += seconds[-1]
            if report:
                self._report(run, last_step, loss, psnr, sum(seconds) / len(seconds))
                seconds.clear()
            for stage in self.during:
                if not stage.edits and stage.due(run.step):
                    stage.run(run)
            if run.interrupted:
                path = checkpoint.save(run, keep=2)
                raise Interrupted(f"stopped at step {run.step}, saved in {path}; --resume goes on from there")

    @property
    def comparisons(self) -> list[Loss]:
        """Losses that compare images."""
        return [loss for loss in self.losses if isinstance(loss, Loss)]

    @property
    def penalties(self) -> list[Penalty]:
        """Losses that look at Gaussians."""
        return [loss for loss in self.losses if isinstance(loss, Penalty)]

    @property
    def _edits(self) -> list[Densify]:
        return [stage for stage in self.during if isinstance(stage, Densify)]

    @property
    def statistics(self) -> set[str]:
        """Columns that some density rule reads."""
        return {name for stage in self._edits for name in stage.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that losses and rules read beside the parameters."""
        parts: list[Penalty | Densify] = [*self.penalties, *self._edits]
        return {name for part in parts for name in part.tables}

    def _attach(self, run: Run) -> None:
        """Add the tables that losses and rules read; a resumed run has them."""
        gaussians = run.trained.gaussians
        for name in sorted(self.tables - gaussians.tables.keys()):
            gaussians.add(name, 1)
            run.refresh_filter()

    def _edit(self, run: Run) -> None:
        """What was due at the step before."""
        for stage in self.during:
            if stage.edits and stage.due(run.step):
                stage.run(run)

    def _step(self, run: Run) -> ViewGradients:
        """One view; halfway between reports, where no density control is due, the kernels are timed."""
        assert run.stats is not None
        assert run.adam is not None
        run.step += 1
        run.stage_step += 1
        run.device.timings.sampling = run.step % self.log_every == self.log_every // 2
        model, target = run.trained, run.targets.get(run.train_view())
        run.announce_views()
        background, pixel_sums = run.targets.background_array, run.stats.pixel_sums
        view = differentiate(run.rasterizer, model, target, background, self.comparisons, run.step, pixel_sums)
        stale = {name for stage in self.during if stage.due(run.step) for name in stage.stale(run)}
        if run.stage_step == self.steps:
            stale = set()
        extent = run.scene.extent
        rates = self.rates.at(run.step, extent)
        run.stats.add(view, update(run.rasterizer, model, run.adam, view, rates, self.penalties, stale, extent))
        run.device.timings.sampling = False
        return view

    def _values(self, run: Run, view: ViewGradients) -> tuple[float, float]:
        """Read the step's loss and PSNR.  Raises NumericError, after saving the state, when they are not finite."""
        loss = sum(term.value() for term in view.terms)
        squared = float(pixel_loss(view.comparison, l1=0.0, l2=0.0).get()[..., 1].sum(dtype="float64"))
        error = squared / view.comparison.counted
        broken = run.trained.gaussians.not_finite()
        if broken or not math.isfinite(loss):
            path = checkpoint.save(run, keep=2)
            raise NumericError(
                f"step {run.step}, view '{run.train_view().name}': the loss is {loss}, not finite: "
                f"{', '.join(broken) or 'none of the parameters'}; the state is in {path}; lower the learning rates"
            )
        return loss, -10 * math.log10(max(error, 1e-10))

    def _report(self, run: Run, last_step: int, loss: float, psnr: float, seconds: float) -> None:
        count = run.trained.gaussians.count
        stages = stage_milliseconds(run.device.timings)
        run.records.add(run.step, "train", loss=loss, psnr=psnr, gaussians=count, ms=1e3 * seconds, stages=stages)
        if run.step % (DISTRIBUTION_EVERY * self.log_every) == 0 or run.step == last_step:
            run.records.add(run.step, "distribution", gaussians=count, **distribution(run.trained.gaussians))
        run.records.status("running", run.step, steps=last_step, gaussians=count)
        run.show(Progress(run.step, last_step, loss, psnr, count, 1e3 * seconds, seconds * (last_step - run.step)))
