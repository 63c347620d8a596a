"""The base of all stages: settings, needed and made parts of the run, and one method."""

from abc import abstractmethod
from collections.abc import Collection
from pathlib import PureWindowsPath
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field

from clsplat.settings import Settings
from clsplat.training.run import Run


def path_in_run(suffix: str = "") -> AfterValidator:
    """Mark a field that holds a path inside the run folder, which ends in `suffix`."""

    def checked(text: str) -> str:
        path = PureWindowsPath(text)  # its separators are those of every system
        if path.anchor or ".." in path.parts or (suffix and path.suffix.lower() != suffix):
            raise ValueError(f"expected a path inside the run folder{f' that ends in {suffix}' if suffix else ''}")
        return text

    return AfterValidator(checked)


class Stage(Settings):
    """One stage of a pipeline.  It changes the run and returns nothing."""

    needs: ClassVar[frozenset[str]] = frozenset()  # parts of the run that must exist
    makes: ClassVar[frozenset[str]] = frozenset()  # parts that exist afterwards

    stage: str
    """Name of the stage."""

    def check(self) -> None:
        """Raise errors that do not depend on the run, such as a missing file, before the run starts."""

    @abstractmethod
    def run(self, run: Run) -> None:
        """Run the stage."""


class Scheduled(Stage):
    """A stage that may stand inside `optimize.during`, where it runs at a cadence.

    It runs at every step that is a multiple of `every`, after `start` and before `stop`.
    """

    edits: ClassVar[bool] = False  # changes the model; acts between two steps

    every: Annotated[int, Field(gt=0)] | None = None
    """Steps from one run of the stage to the next; inside `during` only."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the stage runs."""
    stop: Annotated[int, Field(gt=0)] | None = None
    """Global step before which the stage runs."""

    def due(self, step: int) -> bool:
        """Return whether the stage runs at a global step, counted from 1."""
        if self.every is None or step % self.every != 0:
            return False
        return step > self.start and (self.stop is None or step < self.stop)

    def stale(self, run: Run) -> Collection[str]:
        """Return the parameters whose gradients the edit makes invalid."""
        return ()
