"""Define the base classes of stages, which declare the parts of a run that they need and create."""

from abc import abstractmethod
from collections.abc import Collection, Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args

from pydantic import AfterValidator, Field, field_validator

from clsplat.core.errors import Interrupted, shell_quote
from clsplat.core.files import invalid_output_reason
from clsplat.core.progress import Stopped
from clsplat.core.schedule import EverySteps, fires_at
from clsplat.core.settings import OneOf, Settings
from clsplat.training import checkpoint
from clsplat.training.run import Run

CADENCE = frozenset({"every", "start", "stop"})


@dataclass(frozen=True)
class PathInRun(AfterValidator):
    """Marker of a field that is a path inside the run folder: of a file if there are suffixes, else of a folder."""

    suffixes: tuple[str, ...] = ()


def path_in_run(*suffixes: str) -> PathInRun:
    """Return the marker for the path of a file with one of `suffixes`, or of a folder if there are no suffixes."""

    def check(text: str) -> str:
        fault = invalid_output_reason(text)
        if fault is None and suffixes and not PurePosixPath(text).name.lower().endswith(suffixes):
            fault = f"it does not end in {', '.join(suffixes)}"
        if fault:
            raise ValueError(f"cannot write to this path: {fault}; use another path inside the run folder")
        return text

    return PathInRun(check, suffixes)


def _marks(annotation: Any, metadata: Iterable[Any]) -> list[PathInRun]:
    """Return the markers in `metadata` and, recursively, in the metadata of the type arguments of an annotation."""
    marks = [mark for mark in metadata if isinstance(mark, PathInRun)]
    return marks + [
        mark for argument in get_args(annotation) for mark in _marks(argument, getattr(argument, "__metadata__", ()))
    ]


class Stage(Settings):
    """A stage of a pipeline, which changes the run and returns nothing."""

    needs: ClassVar[frozenset[str]] = frozenset()  # parts of the run that must exist
    makes: ClassVar[frozenset[str]] = frozenset()  # parts that exist afterwards
    removes: ClassVar[frozenset[str]] = frozenset()  # parts that no longer exist afterwards
    edits: ClassVar[bool] = False  # whether it changes the model; if so, `during` runs it between two steps

    stage: str
    """Name of the stage."""

    def check(self) -> None:
        """Raise errors that do not depend on the run, such as a missing file, before the run starts."""

    def check_run(self, run: Run) -> None:
        """Raise errors that can be detected before the first stage of a run, including a dry run."""

    @abstractmethod
    def run(self, run: Run) -> None:
        """Run the stage."""

    def outputs(self, out: Path) -> list[Path]:
        """Return the files and folders in the run folder `out` that the stage writes."""
        values = (getattr(self, name) for name in self.named_outputs())
        return [out / value for value in values if value is not None]

    @classmethod
    def named_outputs(cls) -> dict[str, tuple[str, ...]]:
        """Return the allowed file extensions of each setting that is a path inside the run folder, by setting name."""
        marks = {name: _marks(field.annotation, field.metadata) for name, field in cls.model_fields.items()}
        return {name: files[0].suffixes for name, files in marks.items() if files}

    def act(self, run: Run) -> None:
        """Run the stage and report it in status.json.  A failure during an edit leaves the run inconsistent.

        On resume, a failed stage is repeated from its start, so its records are dropped.
        """
        edit = run.editing_tables() if self.edits else nullcontext()
        with run.status.stage(self.stage), edit, run.records.stage():
            self.run(run)


ON_HOST = "harmonics on the host"
ALL_HARMONICS = {
    ON_HOST: "it changes the harmonics of all Gaussians on the device; set rasterizer.harmonics: device, or remove it"
}


class Scheduled(Stage):
    """A stage that can be listed in `optimize.during` and runs at a cadence.

    It runs at every multiple of `every`, rounded down, after step `start` and before step `stop`.
    """

    training_keys: ClassVar[frozenset[str]] = CADENCE
    step_keys: ClassVar[frozenset[str]] = CADENCE
    runs_at_end: ClassVar[bool] = False  # whether it also runs after the last step of training

    every: EverySteps | None = None
    """Number of steps from one run of the stage to the next, which may be fractional; only in `during`."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the stage runs."""
    stop: Annotated[int, Field(gt=0)] | None = None
    """Global step before which the stage runs."""

    def attach(self, run: Run) -> None:
        """Add the tables that the stage needs, before the first step; a resumed run already has them."""

    def finish(self, run: Run) -> None:
        """Finish after the last step of training.  A resumed run may call this again."""

    def is_due(self, step: int, is_last: bool = False) -> bool:
        """Return whether the stage runs at a global step.  is_last: whether it is the last step of training."""
        if self.every is None or not (fires_at(self.every, step) or (is_last and self.runs_at_end)):
            return False
        return step > self.start and (self.stop is None or step < self.stop)

    def is_overdue(self, run: Run) -> bool:
        """Return whether to run the stage now in addition to its cadence; only for stages that never change results."""
        return False

    def frozen_parameters(self, run: Run) -> Collection[str]:
        """Return the parameters that a step does not update, because the edit after it invalidates their gradients."""
        return ()


def find_output_conflict(stages: Sequence[Stage]) -> str | None:
    """Return a path that two stages would both write, unless both write it as a folder; None if there is none.

    Stages may share a folder.  Names are compared ignoring case, as some file systems do.
    """
    earlier_paths: list[tuple[tuple[str, ...], bool]] = []  # components of each path, and whether it is a file
    for stage in stages:
        if not (outputs := stage.named_outputs()):  # other stages write its files
            continue
        suffixes = tuple(suffix for endings in outputs.values() for suffix in endings)
        paths = [
            (tuple(part.casefold() for part in path.parts), path.name.lower().endswith(suffixes))
            for path in stage.outputs(Path())
        ]
        for parts, is_file in paths:
            for earlier_parts, earlier_is_file in earlier_paths:
                if (is_file and earlier_parts[: len(parts)] == parts) or (
                    earlier_is_file and parts[: len(earlier_parts)] == earlier_parts
                ):
                    return "/".join(parts)
        earlier_paths += paths
    return None


# A stage that trains for a number of steps, with stages that run between steps.


class Training(Stage):
    """A stage that trains for a number of steps, and runs other stages between steps."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"steps"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"steps"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"log_every"})
    rehearsal_steps: ClassVar[int] = 200  # steps timed for `--minutes`; also the minimum number of training steps

    steps: Annotated[int, Field(gt=0)]
    """Number of training steps."""
    if TYPE_CHECKING:  # declared by subclasses, after their own fields, for the order of keys in files
        during: list[OneOf[Scheduled]]
        log_every: int

    @field_validator("during", check_fields=False)
    @classmethod
    def _require_cadence(cls, during: list[Scheduled]) -> list[Scheduled]:
        for stage in during:
            if stage.every is None:
                raise ValueError(f"'{stage.stage}' needs 'every' inside 'during'")
        return during

    def check(self) -> None:
        for stage in self.during:
            stage.check()

    def check_run(self, run: Run) -> None:
        for stage in self.during:
            if stage.stop is None or stage.stop > run.step + 1:  # otherwise it will not run again
                stage.check_run(run)

    def outputs(self, out: Path) -> list[Path]:
        return [path for stage in self.during for path in stage.outputs(out)]

    def active_stages(self, step: int) -> list[Scheduled]:
        """Return the stages of `during` that will run if training starts after a global step."""
        last = step + self.steps
        inner_steps = range(step + 1, last)  # no edit runs after the last step
        return [s for s in self.inner if any(map(s.is_due, inner_steps)) or (not s.edits and s.is_due(last, True))]

    @property
    def inner(self) -> list[Scheduled]:
        """The stages that run between steps, in order."""
        return self.order_stages(self.during)

    def order_stages(self, during: Sequence[Scheduled]) -> list[Scheduled]:
        """Return the stages of `during` in the order in which they run."""
        return list(during)

    def has_ended(self, run: Run) -> bool:
        """Return whether the stage has completed all its steps."""
        return run.stage_step >= self.steps

    def after_stage(self, run: Run, stage: Scheduled) -> None:
        """Called after a stage of `during` has run."""

    def finish(self, run: Run) -> None:
        """Finish training after the last step."""

    def act(self, run: Run) -> None:
        with run.status.stage(self.stage):  # no records are dropped: it resumes in the middle
            self.run(run)

    def act_between(self, run: Run) -> None:
        """Run the due stages that do not edit the model.  A stage that fails runs again on resume."""
        for index, stage in enumerate(self.inner):
            is_due = run.stage_step > 0 and (stage.is_due(run.step, self.has_ended(run)) or stage.is_overdue(run))
            if index < run.during_index or stage.edits or not is_due:
                continue
            run.during_index = index + 1  # before it runs, for the checkpoint that it may write
            try:
                stage.act(run)
                self.after_stage(run, stage)
            except BaseException:
                run.during_index = index
                raise

    def end_step(self, run: Run) -> None:
        """Run the stages due after a step; if the run is interrupted, save the state and raise Interrupted."""
        with suppress(Stopped):
            self.act_between(run)
        run.on_step()
        if run.interrupted:
            remedy = f"`clsplat resume {shell_quote(run.out)}` continues from it"
            raise Interrupted(f"stopped at step {run.step}, saved in {checkpoint.save(run)}; {remedy}")
        if self.has_ended(run):
            self.finish(run)
