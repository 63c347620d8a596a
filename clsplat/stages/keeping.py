"""Which model a training leaves: that of its last step, or the best one by photographs that it did not see."""

import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.cadence import place
from clsplat.errors import ConfigError
from clsplat.stages.base import Scheduled
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.training import Training
from clsplat.training.kept import Best, Measured
from clsplat.training.kept_tables import copied_of, put_back
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
EVALUATIONS, SHORTEST = 20, 100  # of a training at most; steps from one to the next at least
PSNR_AND_SSIM = ("psnr", "ssim")
SHOWN = 8  # training views that are measured beside the validation views, at most


class Keeping(Training):
    """A training with a number of steps, and the model that it leaves.

    With `keep: best` the validation views (`scene.validation`) are measured as often as an `evaluate` of them in
    `during` says, or else every 20th part of the steps, 100 at least; some training views beside them.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"patience"})

    keep: Literal["last", "best"] = "last"
    """Model that the training leaves: that of its last step, or the one with the best PSNR at the validation views, in
    the photographs' colours where all measured views have that figure."""
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
        train = Evaluate.model_validate({**facts, "split": "train", "most": SHOWN, "start": start, "stop": stop})
        return [train] if own else [train, Evaluate.model_validate({**facts, "split": "validation"})]

    @property
    def fewest_steps(self) -> int:
        """The fewest steps of the training, with those of a refit: where no measurement is better than the first."""
        if self.patience is None:
            return self.steps
        every = self.measuring(getattr(self, "during", ()))[-1].every or self.steps
        return min(self.steps, place(every, 1 + self.patience)) + (place(every, 1) if self.refit else 0)

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
        if best is not None and not validation > best.found.validation:
            run.best = best.after(now)
            return
        apart = (best and best.apart) or (now if now.is_apart else None)
        tables, evaluations = copied_of(run), best.evaluations + 1 if best else 1
        copied = {split: dict(one) for split, one in averages.items()}
        run.best = Best(
            found=now,
            degree=run.model.degree,
            metrics=copied,
            numbers=dict(run.numbers),
            evaluations=evaluations,
            since=0,
            apart=apart,
            last=now,
            growth_ended=best.growth_ended if best else None,
        )
        run.best_tables = tables

    def has_ended(self, run: Run) -> bool:
        """Whether no step of the training is left."""
        best = run.best if self.keep == "best" and run.stage_step else None
        ended = best is not None and self.patience is not None and best.since >= self.patience
        return ended or run.stage_step >= self.steps

    def leave(self, run: Run) -> None:
        """At the end of the training, put the best model into the place of the last one."""
        best = run.best
        if self.keep == "last" or best is None or best.taken is not None:
            return
        with run.changing():
            if best.found.step != run.step:
                put_back(run, run.best_tables, best.degree)
                run.adam = run.stats = None
                run.numbers.update(best.numbers)
            run.metrics.update(best.metrics)
            run.best = best.model_copy(update={"taken": run.step, "refit": "due" if self.refit else "none"})
            run.best_tables = {}
        LOG.info("%s", run.best.told())


def compared(measured: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """Return the PSNR of averages of metrics, dB, None where there is none: in the photographs' colours where all have
    it of all their views."""
    whole = all(one.get("psnr_colour") is not None and "psnr_colour_reason" not in one for one in measured)
    return [one.get("psnr_colour" if whole else "psnr") for one in measured]


def _validates(stage: Scheduled) -> bool:
    """Whether a stage measures validation views at the size of the training."""
    if not isinstance(stage, Evaluate) or stage.split != "validation":
        return False
    return stage.file is None and stage.downscales is None
