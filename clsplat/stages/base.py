"""What every stage is: settings, what it needs, what it makes, and one method."""

from abc import abstractmethod
from collections.abc import Collection
from typing import Annotated, ClassVar

from pydantic import Field

from clsplat.settings import Settings
from clsplat.training.run import Run


class Stage(Settings):
    """One step of a pipeline.  It changes the run and returns nothing.

    Inside `optimize.during` a stage runs at every step that is a multiple of `every`, after `start` and before `stop`.
    """

    needs: ClassVar[frozenset[str]] = frozenset()  # parts of the run that must exist
    makes: ClassVar[frozenset[str]] = frozenset()  # parts that exist afterwards
    edits: ClassVar[bool] = False  # changes the model: acts between a step and the next

    stage: str  # the name in a pipeline file
    every: Annotated[int, Field(gt=0)] | None = None  # steps
    start: Annotated[int, Field(ge=0)] = 0  # global step, exclusive
    stop: Annotated[int, Field(gt=0)] | None = None  # global step, exclusive

    def due(self, step: int) -> bool:
        """Whether the stage runs at a global step, counted from 1."""
        if self.every is None or step % self.every != 0:
            return False
        return step > self.start and (self.stop is None or step < self.stop)

    def stale(self, run: Run) -> Collection[str]:
        """Parameters whose gradients the edit makes meaningless."""
        return ()

    def check(self) -> None:
        """Raise now what would stop the stage later, such as a missing file."""

    @abstractmethod
    def run(self, run: Run) -> None:
        """Do it."""
