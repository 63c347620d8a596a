"""The training loop: render, compare, differentiate, update."""

import itertools
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from clsplat.core.errors import ConfigError
from clsplat.core.progress import Progress
from clsplat.core.schedule import fire_step
from clsplat.core.settings import OneOf
from clsplat.density.statistics import SplatStats
from clsplat.losses.base import ImageLoss, Loss, Penalty, ViewLosses
from clsplat.metrics.views import distribution
from clsplat.photos.sampling import Sampler, ViewSettings
from clsplat.stages.densify import Densify
from clsplat.stages.evaluate import Evaluate
from clsplat.training.adam import Adam, Rates, Rows
from clsplat.training.best_model import Best, Measured
from clsplat.training.checkpoint import copy_model, finite_values, put_back
from clsplat.training.modules.base import ModuleState, TrainingModule, attach_modules, check_list, implied_modules
from clsplat.training.records import Forecast, clocks, stage_milliseconds
from clsplat.training.run import Run
from clsplat.training.sh_offload import more_room, place_harmonics
from clsplat.training.stage import Scheduled, Training
from clsplat.training.trainer import StepTrainer

# Which model a training leaves: that of its last step, or the best one by photographs that it did not see.

LOG = logging.getLogger("clsplat")
EVALUATIONS, SHORTEST = 20, 100  # of a training at most; steps from one to the next at least
PSNR_AND_SSIM = ("psnr", "ssim")
ROOMY = 8  # times the first number of Gaussians fit: growth then rarely reaches the limit
SHOWN = 8  # training views that are measured beside the validation views, at most


class Keeping(Training):
    """A training with a number of steps, and the model that it leaves.

    With `keep: best` the validation views (`scene.validation`) are measured as often as an `evaluate` of them in
    `during` says, or else every 20th part of the steps, 100 at least; some training views beside them.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"patience"})

    keep: Literal["last", "best"] = "last"
    """Model that the training leaves: that of its last step, or the one with the best PSNR at the validation views, in
    the photographs' colors where all measured views have that figure."""
    patience: Annotated[int, Field(gt=0)] | None = None
    """Measurements of the validation views without a better one after which the training ends; without it, none."""
    refit: bool = False
    """With `keep: best`: train again from the beginning on all training photographs, those for validation too, for the
    number of steps that was best."""

    @model_validator(mode="after")
    def _by_validation(self) -> "Keeping":
        if self.keep != "best" and (self.patience or self.refit):
            raise ValueError(f"'{'patience' if self.patience else 'refit'}' is for 'keep: best'; give both or neither")
        inner = self.during
        if self.keep != "best" and any(getattr(stage, "patience", None) for stage in inner):
            raise ValueError("'densify.patience' is for 'keep: best'; give both or neither")
        if self.keep == "best" and any("average" in stage.makes for stage in inner):
            raise ValueError(
                "'keep: best' leaves the model of one step, and not the average of several; choose one, or a pipeline "
                "without 'add_to_average' and 'take_average', such as splat_7k"
            )
        return self

    def measuring(self, during: Sequence[Scheduled]) -> list[Evaluate]:
        """Return the measurements that `keep: best` adds to `during`: of training views, then of validation views."""
        if self.keep == "last":
            return []
        own = next((stage for stage in during if _validates(stage)), None)
        parts = max(1, min(EVALUATIONS, self.steps // SHORTEST))  # whole ones: what is not measured cannot be the best
        every = own.every if own else self.steps // parts
        start, stop = (own.start, own.stop) if own else (0, None)
        facts = {"metrics": [*PSNR_AND_SSIM], "every": every}
        train = Evaluate.model_validate({**facts, "split": "train", "max_views": SHOWN, "start": start, "stop": stop})
        return [train] if own else [train, Evaluate.model_validate({**facts, "split": "validation"})]

    @property
    def min_steps(self) -> int:
        """The fewest steps of the training, with those of a refit: where no measurement is better than the first."""
        if self.patience is None:
            return self.steps
        every = self.measuring(getattr(self, "during", ()))[-1].every or self.steps
        return min(self.steps, fire_step(every, 1 + self.patience)) + (fire_step(every, 1) if self.refit else 0)

    def in_turn(self, during: Sequence[Scheduled]) -> list[Scheduled]:
        """Return all stages of `during` in the order in which they act: first the measurements of `keep: best`, since
        they may end the training."""
        first = sorted(during, key=lambda stage: not _validates(stage)) if self.keep == "best" else during
        return [*self.measuring(during), *first]

    def begin_to_keep(self, run: Run) -> None:
        """Forget the best of an earlier training.  Raises ConfigError where there is nothing to choose by."""
        if self.keep == "last":
            return
        if not run.scene.split("validation"):
            raise ConfigError(
                "optimize.keep: best chooses by validation views; expected some: set scene.validation=auto"
            )
        self.require_measured(run.step - run.stage_step)
        if run.stage_step == 0:
            run.best, run.best_tables = None, {}

    def check_pipeline(self, pipeline: Any) -> None:
        if self.keep == "best" and pipeline.scene.validation == 0:
            raise ConfigError("optimize.keep: best chooses by validation views; expected scene.validation: auto")
        trainings = [stage for stage in pipeline.stages if isinstance(stage, Training)]
        if self.refit and (found := sum(isinstance(one, Keeping) for one in trainings)) > 1:
            raise ConfigError(f"optimize.refit: expected one stage that trains, found {found}")
        before = list(itertools.takewhile(lambda one: one is not self, trainings))
        if not any(getattr(one, "patience", None) for one in before):  # else nobody knows at which step it begins
            self.require_measured(sum(one.steps for one in before))

    def require_measured(self, begun: int) -> None:
        """Raise ConfigError where `keep: best` measures nothing before the last step; begun: global step before it."""
        if self.keep == "last":
            return
        last = begun + self.steps
        found = [stage for stage in self.in_turn(self.during) if _validates(stage)]
        if not any(stage.due(step, step == last) for stage in found for step in range(begun + 1, last + 1)):
            raise ConfigError(
                "optimize.keep: best needs a measurement of the validation views before the last step; expected "
                "an `evaluate: {every: …, split: validation}` in `during` that is due, or none: it is made then"
            )

    def judge(self, run: Run, stage: Scheduled) -> None:
        """After a measurement of the validation views, keep the model where it is the best so far."""
        if self.keep == "last" or not _validates(stage):
            return
        averages = {split: run.metrics.get(split, {}) for split in ("train", "validation")}
        measured = [one.get(f"{run.downscale:g}", {}) for one in averages.values()]
        train, validation = compared(measured)
        if train is None or validation is None:  # at another size, or masks leave out all
            return
        best, now = run.best, Measured(step=run.step, train=train, validation=validation)
        if best is not None and not validation > best.measured.validation:
            run.best = best.after(now)
            return
        first_overfit = (best and best.first_overfit) or (now if now.is_overfit else None)
        tables, evaluations = copy_model(run), best.evaluations + 1 if best else 1
        copied = {split: dict(one) for split, one in averages.items()}
        run.best = Best(
            measured=now,
            degree=run.model.degree,
            metrics=copied,
            scalars=dict(run.scalars),
            modules={name: dict(one.scalars) for name, one in run.modules.items() if one.after_training != "dropped"},
            evaluations=evaluations,
            since_best=0,
            first_overfit=first_overfit,
            last=now,
            growth_ended=best.growth_ended if best else None,
        )
        run.best_tables = tables

    def has_ended(self, run: Run) -> bool:
        """Whether no step of the training is left."""
        best = run.best if self.keep == "best" and run.stage_step else None
        ended = best is not None and self.patience is not None and best.since_best >= self.patience
        return ended or run.stage_step >= self.steps

    def leave(self, run: Run) -> None:
        """At the end of the training, put the best model into the place of the last one."""
        best = run.best
        if self.keep == "last" or best is None or best.ended is not None:
            return
        with run.editing_tables():
            if best.measured.step != run.step:
                put_back(run, run.best_tables, best)
                run.adam = run.stats = None
                run.scalars.update(best.scalars)
            run.metrics.update(best.metrics)
            run.best = best.model_copy(update={"ended": run.step, "refit": "due" if self.refit else "none"})
            run.best_tables = {}
        LOG.info("%s", run.best.text())


def compared(measured: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """Return the PSNR of averages of metrics, dB, None where there is none: in the photographs' colors where all have
    it of all their views."""
    whole = all(one.get("psnr_color") is not None and "psnr_color_reason" not in one for one in measured)
    return [one.get("psnr_color" if whole else "psnr") for one in measured]


def _validates(stage: Scheduled) -> bool:
    """Whether a stage measures validation views at the size of the training."""
    if not isinstance(stage, Evaluate) or stage.split != "validation":
        return False
    return stage.file is None and stage.downscales is None


# What a training tells of itself every so many steps.


def report(
    run: Run, forecast: Forecast, values: tuple[float, float], seconds: Sequence[float], distribution_every: int = 1
) -> None:
    """Record a step and show it.

    values: its loss and its PSNR, dB; seconds: of the steps since the last report; distribution_every: steps from one
    record of the Gaussians' sizes and opacities to the next.
    """
    count, (loss, psnr) = run.gaussians, values
    stages, ms = stage_milliseconds(run.device.timings), 1e3 * median(seconds)  # the first step may load much
    cost = {"ms": ms, "cpu_seconds": round(run.cpu_seconds, 3), "stages": stages}
    run.records.add(run.step, "train", loss=loss, psnr=psnr, **({} if count is None else {"gaussians": count}), **cost)
    if count is not None and (run.step % distribution_every == 0 or run.step == forecast.last_step):
        run.records.add(run.step, "distribution", gaussians=count, **distribution(run.model.gaussians))
    run.records.write()
    forecast.add(run.step, psnr, count or 1, fmean(seconds))
    left, known = forecast.seconds_left, forecast.growth_known
    run.status.note(gaussians=count, seconds_left=round(left, 1))
    run.on_progress(Progress(run.step, forecast.last_step, loss, forecast.psnr, count, ms, left, known))


DISTRIBUTION_INTERVAL, READ_AHEAD = 5, 4  # reports; photographs


class Optimize(Keeping):
    """Train for a number of steps, one view each (Kerbl et al. 2023).

    Stages in `during` that edit the model act between two steps, so that other stages see the model before the edit.
    No edit follows the last step.  As in the reference, a parameter is not updated at the step before its edit.
    """

    stage: Literal["optimize"] = "optimize"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"adam", "stats"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"rates", "update"})

    rates: Rates = Rates()
    """Learning rates."""
    update: Rows = "all"
    """Gaussians that a step changes: `all`, or `seen`: those that the view culls keep their parameters and moments.
    `deferred`: all, with the same bits; `sh_rest` of those that are culled has its updates when a view sees them."""
    views: ViewSettings = ViewSettings()
    """View, size and photograph of each step."""
    losses: list[OneOf[Loss]]
    """Losses and penalties; training minimizes their sum."""
    modules: list[OneOf[TrainingModule]] = Field([])
    """What takes part in a step next to the Gaussians, in the order of the forward pass; each once.  `--set` addresses
    one by its type: `optimize.modules.TYPE.KEY=…`; `optimize.modules.TYPE={}` adds it at its place, `=null` removes
    it."""
    during: list[OneOf[Scheduled]] = Field([])
    """Stages that run every so many steps."""
    log_every: Annotated[int, Field(gt=0)] = 100
    """Steps between lines of metrics.jsonl."""

    @field_validator("losses")
    @classmethod
    def _of_an_image(cls, losses: list[Loss]) -> list[Loss]:
        if not any(isinstance(loss, ImageLoss) and loss.reads_photograph for loss in losses):
            raise ValueError("expected at least one loss that compares images, such as l1")
        return losses

    @field_validator("modules")
    @classmethod
    def _in_order(cls, modules: list[TrainingModule]) -> list[TrainingModule]:
        check_list(modules)
        return modules

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

    def iterate(self, run: Run) -> Iterator[ViewLosses]:
        """Train step by step; what a step yields, ViewGradients unless it is skipped, is valid until the next."""
        self.begin_to_keep(run)
        views = self.views.settled(run.training_images)
        last_step = run.step - run.stage_step + self.steps
        trainer, sampler = self._trainer(run, views, last_step), Sampler(run.scene.split("train"), views, run.seed)
        memory, count = run.memory_plan(), run.model.gaussians.count
        if run.harmonics != "auto" or memory.host == 0:  # else it was looked at before they moved
            memory.check(count, more_room(run))
        is_tight = memory.host or memory.limit < ROOMY * count
        LOG.log(logging.INFO if is_tight else logging.DEBUG, memory.text(count))
        forecast = Forecast.of(run.step, last_step, [stage.due for stage in self._density])
        seconds: list[float] = []  # of the steps since the last report
        self.act_between(run)
        while not self.has_ended(run):
            start = clocks()
            self._edit(run, views)
            view = self._step(run, trainer, sampler)
            run.status.count("steps", run.stage_step, self.steps, step=run.step, steps=last_step)
            is_reported = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            loss, psnr = finite_values(run, sampler.at(run.step).view.name, view) if is_reported else (0.0, 0.0)
            seconds.append(run.add_training_time(start))
            if is_reported:
                for module in trainer.modules if run.step == last_step else ():
                    module.finish(run)
                report(run, forecast, (loss, psnr), seconds, DISTRIBUTION_INTERVAL * self.log_every)
                seconds.clear()
            self.end_step(run)
            yield view
        self.leave(run)  # a resumed run may have no step left
        for module in trainer.modules:
            module.write(run)

    @property
    def statistics(self) -> set[str]:
        """Columns of statistics that density rules read."""
        return {name for stage in self._density for name in stage.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that penalties and rules read beside the parameters."""
        parts: list[Penalty | Densify] = [*(loss for loss in self.losses if isinstance(loss, Penalty)), *self._density]
        return {name for part in parts for name in part.tables}

    @property
    def _density(self) -> list[Densify]:
        return [stage for stage in self.during if isinstance(stage, Densify)]

    def _trainer(self, run: Run, views: ViewSettings, last: int) -> StepTrainer:
        """Attach moments, statistics and tables to the run's Gaussians; a resumed run has them."""
        gaussians, photographs = run.model.gaussians, run.photographs
        run.stats = SplatStats(gaussians, self.statistics, len(run.scene.split("train")))
        for name in sorted(self.tables - gaussians.tables.keys()):
            gaussians.add(name, 1)
            run.refresh_filter()
        for stage in self.during:
            stage.attach(run)
        place_harmonics(run)
        run.adam = run.adam or Adam(gaussians)
        parts = run.rasterizer, run.model, run.adam, run.stats, photographs.background
        rates = self.rates.settled(views.full_size(last))
        states: list[ModuleState] = attach_modules(self.modules, run, last)
        trained = self.losses, rates, run.scene.extent, self.update
        return StepTrainer(*parts, *trained, modules=states)

    def _edit(self, run: Run, views: ViewSettings) -> None:
        """Run the edits that were due at the step before."""
        if run.stage_step == 0 or run.edited:
            return
        run.image_downscale = views.divisor(run.step)
        with run.editing_tables():
            for stage in (stage for stage in self.during if stage.edits and stage.due(run.step)):
                stage.act(run)
            run.edited = True

    def _step(self, run: Run, trainer: StepTrainer, sampler: Sampler) -> ViewLosses:
        """Do one step; a failure before its update leaves the run at the step before."""
        run.step += 1
        run.stage_step += 1
        try:
            view, stale = self._differentiate(run, trainer, sampler)
        except BaseException:  # a second Ctrl-C too
            run.step, run.stage_step = run.step - 1, run.stage_step - 1
            run.device.timings.sampling = False
            raise
        with run.editing_tables():
            trainer.update(view, stale)
            run.during_index, run.edited = 0, False
        run.device.timings.sampling = False
        run.status.note(step=run.step)
        return view

    def _differentiate(self, run: Run, trainer: StepTrainer, sampler: Sampler) -> tuple[ViewLosses, set[str]]:
        """The losses of one view, with gradients unless it is skipped, and the parameters that they do not update."""
        run.device.timings.sampling = run.step % self.log_every == self.log_every // 2  # away from density edits
        sample = sampler.at(run.step)
        photograph = run.photographs.of_sizes(sample.view, sample.original, sample.number)
        ahead = range(1, min(READ_AHEAD, self.steps - run.stage_step) + 1)
        run.photographs.announce(sampler.at(run.step + number).view for number in ahead)
        stale = {name for stage in self.during if stage.due(run.step) for name in stage.stale(run)}
        trainer.losses = [*self.losses, *run.losses]
        view = trainer.differentiate(photograph, run.step, sample.transforms)
        return view, set() if run.stage_step == self.steps else stale
