"""Train: render, compare, differentiate, update."""

import itertools
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from clsplat.core.errors import ConfigError
from clsplat.core.progress import Progress
from clsplat.core.schedule import AtLeastOne, fire_step
from clsplat.core.settings import OneOf
from clsplat.density.statistics import SplatStats
from clsplat.losses.base import ImageLoss, Loss, Penalty, ViewGradients
from clsplat.metrics.views import distribution
from clsplat.photos.photographs import Photograph
from clsplat.photos.sampling import Sampler, ViewSettings
from clsplat.photos.transforms import PhotographTransform
from clsplat.stages.densify import Densify
from clsplat.stages.evaluate import Evaluate
from clsplat.training.adam import Adam, Rates, Rows, attach_gradients
from clsplat.training.best_model import Best, Scores
from clsplat.training.checkpoint import copy_model, finite_values, restore_best
from clsplat.training.modules.base import ModuleState, TrainingModule, attach_modules, check_list, implied_modules
from clsplat.training.records import Forecast, read_clocks, stage_milliseconds
from clsplat.training.run import Run
from clsplat.training.sh_offload import offload_advice, offload_harmonics
from clsplat.training.stage import ALL_HARMONICS, Scheduled, Training
from clsplat.training.trainer import StepTrainer

LOG = logging.getLogger("clsplat")
MAX_EVALUATIONS, MIN_INTERVAL = 20, 100  # evaluations of a training run, steps between two of them
PSNR_AND_SSIM = ("psnr", "ssim")
MEMORY_MARGIN = 8  # growth rarely reaches a memory limit that is this multiple of the initial number of Gaussians
MAX_TRAINING_VIEWS = 8  # training views that are measured with the validation views


class ValidatedTraining(Training):
    """Training that keeps its last model, or its best model on the validation views.

    With `keep: best`, the validation views (`scene.validation`) and some training views are measured whenever an
    `evaluate` of validation views in `during` runs; without one, 20 times, at least 100 steps apart.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"patience"})

    keep: Literal["last", "best"] = "last"
    """Model to keep: the last one, or the one with the best PSNR of the validation views.  If all measured
    views have a `psnr_color`, that is used as the PSNR."""
    patience: Annotated[int, Field(gt=0)] | None = None
    """Number of measurements of the validation views without improvement after which the training ends; default: it
    does not end early."""
    refit: bool = False
    """With `keep: best`: train again from the start for the best number of steps, on the validation views too."""

    @model_validator(mode="after")
    def _require_keep_best(self) -> "ValidatedTraining":
        if self.keep != "best" and (self.patience or self.refit):
            raise ValueError(f"'{'patience' if self.patience else 'refit'}' needs 'keep: best'; set both or neither")
        if self.keep != "best" and any(getattr(stage, "patience", None) for stage in self.during):
            raise ValueError("'densify.patience' needs 'keep: best'; set both or neither")
        if self.keep == "best" and any(stage.stage == "average" for stage in self.during):
            raise ValueError(
                "'keep: best' keeps the model of one step, not an average; remove `keep` or `average`, or use a "
                "pipeline without 'average', such as splat_7k"
            )
        return self

    def measurements(self, during: Sequence[Scheduled]) -> list[Evaluate]:
        """Return the evaluations that `keep: best` adds to `during`: training views, then validation views."""
        if self.keep == "last":
            return []
        validating_stage = next((stage for stage in during if _validates(stage)), None)
        # equal intervals, so that the last step is measured
        count = max(1, min(MAX_EVALUATIONS, self.steps // MIN_INTERVAL))
        every = validating_stage.every if validating_stage else self.steps // count
        start, stop = (validating_stage.start, validating_stage.stop) if validating_stage else (0, None)
        keys = {"metrics": [*PSNR_AND_SSIM], "every": every}
        train_keys = {"split": "train", "max_views": MAX_TRAINING_VIEWS, "start": start, "stop": stop}
        train = Evaluate.model_validate({**keys, **train_keys})
        return [train] if validating_stage else [train, Evaluate.model_validate({**keys, "split": "validation"})]

    @property
    def min_steps(self) -> int:
        """The smallest number of steps, including a refit.  It is reached if the first measurement is the best."""
        if self.patience is None:
            return self.steps
        every = self.measurements(getattr(self, "during", ()))[-1].every or self.steps
        return min(self.steps, fire_step(every, 1 + self.patience)) + (fire_step(every, 1) if self.refit else 0)

    def order_stages(self, during: Sequence[Scheduled]) -> list[Scheduled]:
        """Return all stages of `during` in the order in which they run.

        The evaluations of `keep: best` come first, since they may end the training.
        """
        ordered_stages = sorted(during, key=lambda stage: not _validates(stage)) if self.keep == "best" else during
        return [*self.measurements(during), *ordered_stages]

    def reset_best(self, run: Run) -> None:
        """Remove the best model of an earlier training.  Raises ConfigError if there are no validation views."""
        if self.keep == "last":
            return
        if not run.scene.split("validation"):
            raise ConfigError("`optimize.keep: best` needs validation views; set `scene.validation: auto`")
        self.require_measurement(run.step - run.stage_step)
        if run.stage_step == 0:
            run.best, run.best_tables = None, {}

    def check_pipeline(self, pipeline: Any) -> None:
        if self.keep == "best" and pipeline.scene.validation == 0:
            raise ConfigError("`optimize.keep: best` needs validation views; set `scene.validation: auto`")
        training_stages = [stage for stage in pipeline.stages if isinstance(stage, Training)]
        if self.refit and (count := sum(isinstance(stage, ValidatedTraining) for stage in training_stages)) > 1:
            raise ConfigError(f"optimize.refit: expected a single stage that trains, got {count}")
        earlier_stages = list(itertools.takewhile(lambda stage: stage is not self, training_stages))
        if not any(getattr(stage, "patience", None) for stage in earlier_stages):  # else the first step is unknown
            self.require_measurement(sum(stage.steps for stage in earlier_stages))

    def require_measurement(self, start: int) -> None:
        """Raise ConfigError if `keep: best` would not measure any step.

        start: global step before the training.
        """
        if self.keep == "last":
            return
        last = start + self.steps
        stages = [stage for stage in self.order_stages(self.during) if _validates(stage)]
        if not any(stage.is_due(step, step == last) for stage in stages for step in range(start + 1, last + 1)):
            raise ConfigError(
                "`optimize.keep: best` needs an evaluation of the validation views before the end; lower the "
                "`every` of `evaluate` in `during`, or remove that stage to use the default one"
            )

    def after_stage(self, run: Run, stage: Scheduled) -> None:
        """After an evaluation of the validation views, keep the model if it is the best so far."""
        if self.keep == "last" or not _validates(stage):
            return
        averages = {split: run.metrics.get(split, {}) for split in ("train", "validation")}
        metrics = [average.get(f"{run.downscale:g}", {}) for average in averages.values()]
        train, validation = comparable_psnr(metrics)
        if train is None or validation is None:  # measured at another size, or everything is masked
            return
        best, scores = run.best, Scores(step=run.step, train=train, validation=validation)
        if best is not None and not validation > best.measured.validation:
            run.best = best.with_last(scores)
            return
        first_overfit = (best and best.first_overfit) or (scores if scores.is_overfit else None)
        tables, evaluations = copy_model(run), best.evaluations + 1 if best else 1
        metrics_copy = {split: dict(average) for split, average in averages.items()}
        run.best = Best(
            measured=scores,
            degree=run.model.degree,
            metrics=metrics_copy,
            scalars=dict(run.scalars),
            modules={
                name: dict(state.scalars) for name, state in run.modules.items() if state.after_training != "dropped"
            },
            evaluations=evaluations,
            since_best=0,
            first_overfit=first_overfit,
            last=scores,
            growth_ended=best.growth_ended if best else None,
        )
        run.best_tables = tables

    def has_ended(self, run: Run) -> bool:
        """Return whether the training has no steps left."""
        best = run.best if self.keep == "best" and run.stage_step else None
        is_out_of_patience = best is not None and self.patience is not None and best.since_best >= self.patience
        return is_out_of_patience or run.stage_step >= self.steps

    def finish(self, run: Run) -> None:
        """Replace the last model with the best model at the end of training."""
        best = run.best
        if self.keep == "last" or best is None or best.ended is not None:
            return
        with run.editing_tables():
            if best.measured.step != run.step:
                restore_best(run, run.best_tables, best)
                run.adam = run.stats = None
                run.scalars.update(best.scalars)
            run.metrics.update(best.metrics)
            run.best = best.model_copy(update={"ended": run.step, "refit": "due" if self.refit else "none"})
            run.best_tables = {}
        LOG.info("%s", run.best.text())


def comparable_psnr(averages: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """Return the PSNR of each average in dB, or None if it was not measured.

    The PSNR after color fitting is used if all averages have this value for all their views.
    """
    has_color = all(
        average.get("psnr_color") is not None and "psnr_color_reason" not in average for average in averages
    )
    return [average.get("psnr_color" if has_color else "psnr") for average in averages]


def _validates(stage: Scheduled) -> bool:
    """Return whether a stage measures validation views at the training size."""
    if not isinstance(stage, Evaluate) or stage.split != "validation":
        return False
    return stage.file is None and stage.downscales is None


def report(
    run: Run, forecast: Forecast, values: tuple[float, float], seconds: Sequence[float], distribution_every: int = 1
) -> None:
    """Record a step and report it.

    values: loss and PSNR (dB) of the step.  seconds: times of the steps since the last report.  distribution_every:
    number of steps between records of the Gaussians' sizes and opacities.
    """
    count, (loss, psnr) = run.gaussians, values
    stages, ms = stage_milliseconds(run.device.timings), 1e3 * median(seconds)  # median: the first step loads files
    cost = {"ms": ms, "cpu_seconds": round(run.cpu_seconds, 3), "stages": stages}
    run.records.add(run.step, "train", loss=loss, psnr=psnr, **({} if count is None else {"gaussians": count}), **cost)
    if count is not None and (run.step % distribution_every == 0 or run.step == forecast.last_step):
        run.records.add(run.step, "distribution", gaussians=count, **distribution(run.model.gaussians))
    run.records.write()
    forecast.add(run.step, psnr, count or 1, fmean(seconds))
    seconds_left, is_known = forecast.seconds_left, forecast.is_growth_known
    run.status.note(gaussians=count, seconds_left=round(seconds_left, 1))
    run.on_progress(Progress(run.step, forecast.last_step, loss, forecast.psnr, count, ms, seconds_left, is_known))


DISTRIBUTION_INTERVAL, READ_AHEAD = 5, 4  # reports; photographs


class Optimize(ValidatedTraining):
    """Train for a number of steps with one view each (Kerbl et al. 2023).

    Stages in `during` that edit the model run between two steps, so that other stages see the model before the edit.
    No edit follows the last step.  As in the reference code, a parameter is not updated in the step before its edit.
    """

    stage: Literal["optimize"] = "optimize"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"adam", "stats"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"rates", "update", "views_per_update"})

    rates: Rates = Rates()
    """Learning rates of the Gaussians' parameters."""
    update: Rows = "all"
    """Gaussians that a step updates.  `seen`: culled Gaussians keep their parameters and moments.  `deferred`:
    `sh_rest` of culled Gaussians is updated later, when a view sees them again; the bits are those of `all`."""
    views_per_update: AtLeastOne = 1
    """Number of views whose gradients are averaged for an update, at each step that is a multiple of this number.
    Needs `update: all`."""
    views: ViewSettings = ViewSettings()
    """View, image size and transforms of each step."""
    losses: list[OneOf[Loss]]
    """Losses and penalties; training minimizes their sum."""
    modules: list[OneOf[TrainingModule]] = Field([])
    """Modules that take part in a step in addition to the Gaussians, in the order of the forward pass; each at most
    once.  `--set` addresses a module by its type: `optimize.modules.TYPE.KEY=…`; `optimize.modules.TYPE={}` adds it in
    the right order, `=null` removes it."""
    during: list[OneOf[Scheduled]] = Field([])
    """Stages that run at a cadence."""
    log_every: Annotated[int, Field(gt=0)] = 100
    """Steps between lines of metrics.jsonl."""

    @field_validator("losses")
    @classmethod
    def _require_image_loss(cls, losses: list[Loss]) -> list[Loss]:
        if not any(isinstance(loss, ImageLoss) and loss.reads_photograph for loss in losses):
            raise ValueError("at least one loss must compare images, such as l1")
        return losses

    @field_validator("modules")
    @classmethod
    def _check_modules(cls, modules: list[TrainingModule]) -> list[TrainingModule]:
        check_list(modules)
        return modules

    @model_validator(mode="after")
    def _require_all_rows(self) -> "Optimize":
        if self.views_per_update != 1 and self.update != "all":
            raise ValueError("'views_per_update' needs 'update: all'; set one of them to its default")
        return self

    def active_conflicts(self) -> Mapping[str, str]:
        return ALL_HARMONICS if self.views_per_update != 1 else {}

    def check(self) -> None:
        for module in self.modules:
            module.check_losses(self.losses)
        super().check()

    def outputs(self, out: Path) -> list[Path]:
        files = [name for module in self.modules for name in module.side_files]
        return [*super().outputs(out), *(out / name for name in dict.fromkeys(files))]

    def run(self, run: Run) -> None:
        for _ in self.iterate(run):
            pass

    def check_run(self, run: Run) -> None:
        super().check_run(run)
        for module in (*implied_modules(run, self), *self.modules):
            module.check_run(run)

    def finish(self, run: Run) -> None:
        super().finish(run)
        for stage in self.during:
            stage.finish(run)

    def iterate(self, run: Run) -> Iterator[ViewGradients]:
        """Train step by step.  Yield the losses and gradients of each step, which are valid until the next step."""
        self.reset_best(run)
        views = self.views.resolve(run.training_images)
        last_step = run.step - run.stage_step + self.steps
        trainer = self._create_trainer(run, views, last_step)
        sampler = Sampler(run.scene.split("train"), views, run.seed)
        memory, count = run.memory_plan(), run.model.gaussians.count
        if run.harmonics != "auto" or memory.host == 0:  # else checked before the harmonics moved to the host
            memory.check(count, offload_advice(run))
        is_tight = memory.host or memory.limit < MEMORY_MARGIN * count
        LOG.log(logging.INFO if is_tight else logging.DEBUG, memory.text(count))
        forecast = Forecast.from_rules(run.step, last_step, [stage.is_due for stage in self._density])
        seconds: list[float] = []  # of the steps since the last report
        self.act_between(run)
        while not self.has_ended(run):
            start = read_clocks()
            self._edit(run, views)
            gradients = self._step(run, trainer, sampler)
            run.status.count("steps", run.stage_step, self.steps, step=run.step, steps=last_step)
            is_reported = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            loss, psnr = finite_values(run, sampler.at(run.step).view.name, gradients) if is_reported else (0.0, 0.0)
            seconds.append(run.add_training_time(start))
            if is_reported:
                for module in trainer.modules if run.step == last_step else ():
                    module.finish(run)
                report(run, forecast, (loss, psnr), seconds, DISTRIBUTION_INTERVAL * self.log_every)
                seconds.clear()
            self.end_step(run)
            yield gradients
        self.finish(run)  # a resumed run may have no steps left
        for module in trainer.modules:
            module.write(run)

    @property
    def statistics(self) -> set[str]:
        """The columns of statistics that density rules read."""
        return {name for stage in self._density for name in stage.statistics}

    @property
    def tables(self) -> set[str]:
        """The tables of the Gaussians that penalties and rules read in addition to the parameters."""
        items: list[Penalty | Densify] = [*(loss for loss in self.losses if isinstance(loss, Penalty)), *self._density]
        return {name for item in items for name in item.tables}

    @property
    def _density(self) -> list[Densify]:
        return [stage for stage in self.during if isinstance(stage, Densify)]

    def _create_trainer(self, run: Run, views: ViewSettings, last_step: int) -> StepTrainer:
        """Add moments, statistics and tables to the run's Gaussians, unless a resumed run has them."""
        gaussians, photographs = run.model.gaussians, run.photographs
        run.stats = SplatStats(gaussians, self.statistics, len(run.scene.split("train")))
        for name in sorted(self.tables - gaussians.tables.keys()):
            gaussians.add(name, 1)
            run.refresh_filter()
        for stage in self.during:
            stage.attach(run)
        offload_harmonics(run)
        run.adam = run.adam or Adam(gaussians)
        context = run.rasterizer, run.model, run.adam, run.stats, photographs.background
        rates = self.rates.resolve(views.first_large_step(last_step))
        states: list[ModuleState] = attach_modules(self.modules, run, last_step)
        if self.views_per_update != 1:
            attach_gradients(gaussians)
        settings = self.losses, rates, run.scene.extent, self.update, self.views_per_update
        return StepTrainer(*context, *settings, modules=states)

    def _edit(self, run: Run, views: ViewSettings) -> None:
        """Run the edits due at the previous step."""
        if run.stage_step == 0 or run.edited:
            return
        run.image_downscale = views.divisor(run.step)
        with run.editing_tables():
            for stage in (stage for stage in self.during if stage.edits and stage.is_due(run.step)):
                stage.act(run)
            run.edited = True

    def _step(self, run: Run, trainer: StepTrainer, sampler: Sampler) -> ViewGradients:
        """Run one step.  A failure before its update leaves the run at the previous step."""
        run.step += 1
        run.stage_step += 1
        is_done, step_inputs = False, None
        while not is_done:
            try:
                step_inputs = step_inputs or self._prepare_inputs(run, trainer, sampler)
                inputs, frozen = step_inputs
                gradients = trainer.start(*inputs)
            except BaseException:  # also a second Ctrl-C
                run.step, run.stage_step = run.step - 1, run.stage_step - 1
                run.device.timings.sampling = False
                raise
            with run.editing_tables():
                if is_done := trainer.update(gradients, frozen):
                    run.during_index, run.edited = 0, False
        run.device.timings.sampling = False
        run.status.note(step=run.step)
        return gradients

    def _prepare_inputs(
        self, run: Run, trainer: StepTrainer, sampler: Sampler
    ) -> tuple[tuple[Photograph, int, Sequence[PhotographTransform]], set[str]]:
        """Return the inputs of `StepTrainer.start`, and the names of the parameters not to update."""
        run.device.timings.sampling = run.step % self.log_every == self.log_every // 2  # away from density edits
        sample = sampler.at(run.step)
        photograph = run.photographs.get_nonempty(sample.view, sample.original, sample.index)
        offsets = range(1, min(READ_AHEAD, self.steps - run.stage_step) + 1)
        run.photographs.prefetch(sampler.at(run.step + offset).view for offset in offsets)
        frozen = {name for stage in self.during if stage.is_due(run.step) for name in stage.frozen_parameters(run)}
        trainer.losses = [*self.losses, *run.losses]
        return (photograph, run.step, sample.transforms), set() if run.stage_step == self.steps else frozen
