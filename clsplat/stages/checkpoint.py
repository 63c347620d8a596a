"""Saving the run."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.stages.base import Scheduled
from clsplat.training import checkpoint
from clsplat.training.run import Run


class Checkpoint(Scheduled):
    """Write everything that the run needs to go on to the same bits."""

    stage: Literal["checkpoint"] = "checkpoint"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    keep: Annotated[int, Field(gt=0)] = 2
    """Number of the newest checkpoints that stay."""

    def run(self, run: Run) -> None:
        checkpoint.save(run, self.keep)
