"""The base of all stages: settings, needed and made parts of the run, and one method."""

from abc import abstractmethod
from collections.abc import Collection, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, get_args

from pydantic import AfterValidator, Field

from clsplat.cadence import Every, is_act
from clsplat.names import fault_of_output
from clsplat.settings import Settings
from clsplat.training.run import Run

CADENCE = frozenset({"every", "start", "stop"})


@dataclass(frozen=True)
class PathInRun(AfterValidator):
    """Marks a field that holds a path inside the run folder: a file where there is a suffix, else a folder."""

    suffixes: tuple[str, ...] = ()


def path_in_run(*suffixes: str) -> PathInRun:
    """Mark a field that holds a file in the run folder whose name ends in one of `suffixes`, or a folder in it."""

    def checked(text: str) -> str:
        fault = fault_of_output(text)
        if fault is None and suffixes and not PurePosixPath(text).name.lower().endswith(suffixes):
            fault = f"it does not end in {', '.join(suffixes)}"
        if fault:
            raise ValueError(f"expected a path inside the run folder: {fault}")
        return text

    return PathInRun(checked, suffixes)


def _marks(kind: Any, metadata: Iterable[Any]) -> list[PathInRun]:
    """The marks among metadata, and among those of the types that a type is made of."""
    own = [mark for mark in metadata if isinstance(mark, PathInRun)]
    return own + [mark for one in get_args(kind) for mark in _marks(one, getattr(one, "__metadata__", ()))]


class Stage(Settings):
    """One stage of a pipeline.  It changes the run and returns nothing."""

    needs: ClassVar[frozenset[str]] = frozenset()  # parts of the run that must exist
    makes: ClassVar[frozenset[str]] = frozenset()  # parts that exist afterwards
    takes: ClassVar[frozenset[str]] = frozenset()  # parts that do not exist afterwards
    edits: ClassVar[bool] = False  # changes the model; inside `during` it acts between two steps
    changes_last: ClassVar[bool] = False  # says by run.changing() where its edit begins; else all of it is an edit
    reads_harmonics: ClassVar[bool] = False  # of all Gaussians, with a kernel

    stage: str
    """Name of the stage."""

    def check(self) -> None:
        """Raise errors that do not depend on the run, such as a missing file, before the run starts."""

    def check_in(self, run: Run) -> None:
        """Raise errors of a run that can be known before its first stage, for one that is only described."""

    @abstractmethod
    def run(self, run: Run) -> None:
        """Run the stage."""

    def outputs(self, out: Path) -> list[Path]:
        """Return the files and folders of the run folder `out` that the stage writes: those that its fields name."""
        values = (getattr(self, name) for name in self.named_outputs())
        return [out / value for value in values if value is not None]

    @classmethod
    def named_outputs(cls) -> dict[str, tuple[str, ...]]:
        """Return the fields that hold a path inside the run folder, each with the suffixes that a file may have."""
        marks = {name: _marks(field.annotation, field.metadata) for name, field in cls.model_fields.items()}
        return {name: found[0].suffixes for name, found in marks.items() if found}

    def verify(self, run: Run) -> None:
        """Read back what the stage has written.  Raises DataError where it is missing or damaged."""

    def act(self, run: Run) -> None:
        """Run the stage, under its name in status.json; what fails inside of an edit leaves a run that is not whole.

        A stage that fails is repeated from its beginning when the run goes on, so that its records do not stay.
        """
        changing = run.changing() if self.edits and not self.changes_last else nullcontext()
        with run.status.stage(self.stage), changing, run.records.of_a_stage():
            self.run(run)


class Scheduled(Stage):
    """A stage that may stand inside `optimize.during`, where it runs at a cadence.

    It runs at every step that is a multiple of `every`, after `start` and before `stop`; of a number that is not whole,
    at the whole steps at or below its multiples.
    """

    training_keys: ClassVar[frozenset[str]] = CADENCE
    step_keys: ClassVar[frozenset[str]] = CADENCE
    ends: ClassVar[bool] = False  # whether it runs after the last step of the training too

    every: Every | None = None
    """Steps from one run of the stage to the next, which need not be whole; inside `during` only."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the stage runs."""
    stop: Annotated[int, Field(gt=0)] | None = None
    """Global step before which the stage runs."""

    def attach(self, run: Run) -> None:
        """Add tables that the stage keeps beside the parameters, before the first step; a resumed run has them."""

    def due(self, step: int, is_last: bool = False) -> bool:
        """Return whether the stage runs at a global step, counted from 1; `is_last` of the training."""
        if self.every is None or not (is_act(self.every, step) or (is_last and self.ends)):
            return False
        return step > self.start and (self.stop is None or step < self.stop)

    def is_overdue(self, run: Run) -> bool:
        """Return whether the stage runs now beside its cadence: for one that changes no bits."""
        return False

    def stale(self, run: Run) -> Collection[str]:
        """Return the parameters whose gradients the edit makes invalid."""
        return ()


def written_twice(stages: Sequence[Stage]) -> str | None:
    """Return a path that two stages would write, a file or what one stage takes for a folder; None if there is none.

    Stages may share a folder, and those of a cadence may share a file with a later stage.  Names that differ in case
    alone are one file on some systems.
    """
    written: list[tuple[tuple[str, ...], bool]] = []  # the parts of a path, and whether it is a file
    for stage in stages:
        if not (named := stage.named_outputs()):  # what other stages write for it
            continue
        suffixes = tuple(suffix for of_field in named.values() for suffix in of_field)
        own = [
            (tuple(part.casefold() for part in path.parts), path.name.lower().endswith(suffixes))
            for path in stage.outputs(Path())
        ]
        for parts, is_file in own:
            for other, other_is_file in written:
                if (is_file and other[: len(parts)] == parts) or (other_is_file and parts[: len(other)] == other):
                    return "/".join(parts)
        written += own
    return None
