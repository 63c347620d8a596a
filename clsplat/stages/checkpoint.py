"""Save the run at a cadence."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.stages.base import CADENCE, Scheduled
from clsplat.training import checkpoint
from clsplat.training.run import Run


class Checkpoint(Scheduled):
    """Write everything that a resumed run needs to reach the same bits; also after the last step, to train longer."""

    stage: Literal["checkpoint"] = "checkpoint"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    ends: ClassVar[bool] = True
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"keep"}

    keep: Annotated[int, Field(gt=0)] = 2
    """Number of checkpoints that are kept, the newest ones."""

    def run(self, run: Run) -> None:
        checkpoint.save(run, self.keep)
