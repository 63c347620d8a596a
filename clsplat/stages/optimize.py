"""The training loop: render, compare, differentiate, update."""

import logging
import math
import time
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from clsplat.errors import Interrupted, NumericError
from clsplat.stages.base import Stage
from clsplat.stages.checkpoint import Checkpoint
from clsplat.stages.densify import Densify
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.export import Export
from clsplat.stages.schedule import RaiseSh, ResetOpacity
from clsplat.training import checkpoint
from clsplat.training.adam import Adam, Rates
from clsplat.training.density import SplatStats
from clsplat.training.losses import AnyLoss, Comparison, Term, pixel_loss
from clsplat.training.profile import stage_milliseconds
from clsplat.training.run import Progress, Run
from clsplat.training.targets import unpack

LOG = logging.getLogger("clsplat")
Scheduled = Annotated[RaiseSh | Densify | ResetOpacity | Checkpoint | Evaluate | Export, Field(discriminator="stage")]


class Optimize(Stage):
    """Train for a number of steps, one view each (Kerbl et al. 2023).

    Stages in `during` that edit parameters run between a step's gradients and its update, as in the reference: a
    gradient that the edit made stale is discarded.  The others run after the update.
    """

    stage: Literal["optimize"] = "optimize"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"adam", "stats"})

    steps: Annotated[int, Field(gt=0)]
    rates: Rates = Rates()
    losses: Annotated[list[AnyLoss], Field(min_length=1)]
    during: list[Scheduled] = Field([])
    log_every: Annotated[int, Field(gt=0)] = 100  # steps between lines of metrics.jsonl

    @field_validator("during")
    @classmethod
    def _on_a_cadence(cls, during: list[Stage]) -> list[Stage]:
        for stage in during:
            if stage.every is None:
                raise ValueError(f"'{getattr(stage, 'stage', '')}' needs 'every' inside 'during'")
        return during

    def run(self, run: Run) -> None:
        model = run.trained
        run.adam = run.adam or Adam(model.gaussians)
        run.stats = run.stats or SplatStats(model.gaussians)
        last_step = run.step - run.stage_step + self.steps
        clock, since = time.perf_counter(), run.step
        while run.stage_step < self.steps:
            comparison, terms = self._sampled_step(run)
            if run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted:
                loss, psnr = self._values(run, comparison, terms)
                now = time.perf_counter()
                seconds = (now - clock) / (run.step - since)
                run.train_seconds += now - clock
                self._report(run, last_step, loss, psnr, seconds)
                clock, since = time.perf_counter(), run.step
            for stage in self.during:
                if not stage.edits and stage.due(run.step):
                    run.train_seconds += time.perf_counter() - clock
                    stage.run(run)
                    clock, since = time.perf_counter(), run.step
            if run.interrupted:
                path = checkpoint.save(run, keep=2)
                raise Interrupted(f"stopped at step {run.step}, saved in {path}; --resume goes on from there")

    def _sampled_step(self, run: Run) -> tuple[Comparison, list[Term]]:
        """One step; halfway between log lines, where no density control is due, its kernels are timed."""
        run.device.timings.sampling = (run.step + 1) % self.log_every == self.log_every // 2
        try:
            return self._step(run)
        finally:
            run.device.timings.sampling = False

    def _step(self, run: Run) -> tuple[Comparison, list[Term]]:
        model, renderer = run.trained, run.renderer
        run.step += 1
        run.stage_step += 1
        target = run.targets.get(run.train_view())
        frame = renderer.forward(model, target.camera, run.targets.background_array)
        workspace, camera = renderer.workspace, target.camera
        photograph = unpack(workspace, camera, target.pixels)
        gradient = workspace.array("grad_image", (3, camera.rows, camera.stride))
        comparison = Comparison(workspace, camera, frame.image, photograph, gradient)
        terms = [loss.add(comparison) for loss in self.losses]
        run.gradients = renderer.backward(model, frame, gradient)
        assert run.stats is not None
        assert run.adam is not None
        run.stats.add(frame, run.gradients)
        for stage in self.during:
            if stage.edits and stage.due(run.step):
                stage.run(run)
        run.adam.step(model, run.gradients, self.rates.at(run.step, run.scene.extent))
        return comparison, terms

    def _values(self, run: Run, comparison: Comparison, terms: list[Term]) -> tuple[float, float]:
        """Read the step's loss and PSNR.  Raises NumericError, after saving the state, when they are not finite."""
        loss = sum(term.value() for term in terms)
        squared = float(pixel_loss(comparison, l1=0.0, l2=0.0).get()[..., 1].sum(dtype="float64")) / comparison.values
        broken = run.trained.gaussians.not_finite()
        if broken or not math.isfinite(loss):
            path = checkpoint.save(run, keep=2)
            raise NumericError(
                f"step {run.step}, view '{run.train_view().name}': the loss is {loss}, not finite: "
                f"{', '.join(broken) or 'none of the parameters'}; the state is in {path}; lower the learning rates"
            )
        return loss, -10 * math.log10(max(squared, 1e-10))

    def _report(self, run: Run, last_step: int, loss: float, psnr: float, seconds: float) -> None:
        count = run.trained.gaussians.count
        stages = stage_milliseconds(run.device.timings)
        run.records.add(run.step, "train", loss=loss, psnr=psnr, gaussians=count, ms=1e3 * seconds, stages=stages)
        run.records.status("running", run.step, steps=last_step, gaussians=count)
        run.show(Progress(run.step, last_step, loss, psnr, count, 1e3 * seconds, seconds * (last_step - run.step)))
