"""Save the run at a cadence."""

import time
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.stages.base import CADENCE, Scheduled
from clsplat.training import checkpoint
from clsplat.training.run import Run


class Checkpoint(Scheduled):
    """Write everything that a resumed run needs to reach the same bits; also after the last step, to train longer."""

    stage: Literal["checkpoint"] = "checkpoint"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    ends: ClassVar[bool] = True
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"keep", "every_seconds"}

    keep: Annotated[int, Field(gt=0)] = 2
    """Number of checkpoints that are kept, the newest ones."""

    every_seconds: Annotated[float, Field(gt=0)] | None = None
    """Seconds without a checkpoint after which one is saved between those of `every`; the bits do not depend on it."""

    def is_overdue(self, run: Run) -> bool:
        return self.every_seconds is not None and time.monotonic() - run.status.saved_at >= self.every_seconds

    def run(self, run: Run) -> None:
        checkpoint.save(run, self.keep)
