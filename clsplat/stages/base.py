"""What every stage is: settings, what it needs, what it makes, and one method."""

from abc import abstractmethod
from collections.abc import Collection
from typing import Annotated, ClassVar

from pydantic import Field

from clsplat.settings import Settings
from clsplat.training.run import Run


class Stage(Settings):
    """One step of a pipeline.  It changes the run and returns nothing."""

    needs: ClassVar[frozenset[str]] = frozenset()  # parts of the run that must exist
    makes: ClassVar[frozenset[str]] = frozenset()  # parts that exist afterwards

    stage: str
    """Name of the stage."""

    def check(self) -> None:
        """Raise now what would stop the stage later, such as a missing file."""

    @abstractmethod
    def run(self, run: Run) -> None:
        """Do it."""


class Scheduled(Stage):
    """A stage that may stand inside `optimize.during`, where it runs at a cadence.

    It runs at every step that is a multiple of `every`, after `start` and before `stop`.
    """

    edits: ClassVar[bool] = False  # changes the model: acts between a step and the next

    every: Annotated[int, Field(gt=0)] | None = None
    """Steps from one run of the stage to the next; inside `during` only."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the stage runs."""
    stop: Annotated[int, Field(gt=0)] | None = None
    """Global step before which the stage runs."""

    def due(self, step: int) -> bool:
        """Whether the stage runs at a global step, counted from 1."""
        if self.every is None or step % self.every != 0:
            return False
        return step > self.start and (self.stop is None or step < self.stop)

    def stale(self, run: Run) -> Collection[str]:
        """Parameters whose gradients the edit makes meaningless."""
        return ()
