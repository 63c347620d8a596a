"""A stage that trains for a number of steps, with stages that run between them."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field, field_validator

from clsplat.errors import Interrupted, in_shell
from clsplat.progress import Stopped
from clsplat.settings import OneOf
from clsplat.stages.base import Scheduled, Stage
from clsplat.training import checkpoint
from clsplat.training.run import Run


class Training(Stage):
    """A training with a number of steps, and stages that act between two of them."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"steps"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"steps"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"log_every"})
    rehearsed: ClassVar[int] = 200  # steps that tell what one takes; no time is so short that fewer are trained

    steps: Annotated[int, Field(gt=0)]
    """Number of training steps."""
    if TYPE_CHECKING:  # fields of each training, behind its own: files have them in that order
        during: list[OneOf[Scheduled]]
        log_every: int

    @field_validator("during", check_fields=False)
    @classmethod
    def _on_a_cadence(cls, during: list[Scheduled]) -> list[Scheduled]:
        for stage in during:
            if stage.every is None:
                raise ValueError(f"'{stage.stage}' needs 'every' inside 'during'")
        return during

    def check(self) -> None:
        for stage in self.during:
            stage.check()

    def check_in(self, run: Run) -> None:
        for stage in self.during:
            if stage.stop is None or stage.stop > run.step + 1:  # else its time has passed
                stage.check_in(run)

    def outputs(self, out: Path) -> list[Path]:
        return [path for stage in self.during for path in stage.outputs(out)]

    def acting(self, step: int) -> list[Scheduled]:
        """Return the stages of `during` that run when the training begins after a global step."""
        last = step + self.steps
        before = range(step + 1, last)  # no edit follows the last
        return [s for s in self.inner if any(map(s.due, before)) or (not s.edits and s.due(last, True))]

    @property
    def inner(self) -> list[Scheduled]:
        """The stages that act between two steps."""
        return self.in_turn(self.during)

    def in_turn(self, during: Sequence[Scheduled]) -> list[Scheduled]:
        """Return all stages of `during` in the order in which they act."""
        return list(during)

    def has_ended(self, run: Run) -> bool:
        """Whether no step of the training is left."""
        return run.stage_step >= self.steps

    def judge(self, run: Run, stage: Scheduled) -> None:
        """Take notice of a stage of `during` that has acted."""

    def leave(self, run: Run) -> None:
        """Do what the end of the training needs."""

    def act(self, run: Run) -> None:
        with run.status.stage(self.stage):  # it goes on in its middle, so that its records stay
            self.run(run)

    def act_between(self, run: Run) -> None:
        """Run the stages that are due and do not edit; those that fail run again when the run goes on."""
        for place, stage in enumerate(self.inner):
            due = run.stage_step > 0 and (stage.due(run.step, self.has_ended(run)) or stage.is_overdue(run))
            if place < run.acted or stage.edits or not due:
                continue
            run.acted = place + 1  # a checkpoint is of the state after it
            try:
                stage.act(run)
                self.judge(run, stage)
            except BaseException:
                run.acted = place
                raise

    def end_step(self, run: Run) -> None:
        """Act after a step; save the state, and raise Interrupted, where the run is to stop."""
        with suppress(Stopped):
            self.act_between(run)
        run.between()
        if run.interrupted:
            told = f"saved in {checkpoint.save(run)}; `clsplat resume {in_shell(run.out)}` goes on from it"
            raise Interrupted(f"stopped at step {run.step}, {told}")
        if self.has_ended(run):
            self.leave(run)
