"""The average of the Gaussians over the last steps of a training, in the place of those of the last step."""

from typing import ClassVar, Literal

from clsplat.stages.base import Scheduled, Stage
from clsplat.training import average
from clsplat.training.run import Run


class AddToAverage(Scheduled):
    """Add every parameter to its average over the steps at which this stage runs (Polyak and Juditsky 1992).

    Training goes on from the parameters themselves.  A Gaussian that is new has an average since then.  What an edit
    changes in Gaussians that stay, such as a reset of opacities, is averaged with what was before: `start` belongs
    after those.
    """

    stage: Literal["add_to_average"] = "add_to_average"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"average"})
    edits: ClassVar[bool] = True
    reads_harmonics: ClassVar[bool] = True

    def attach(self, run: Run) -> None:
        average.attach(run.model.gaussians)

    def run(self, run: Run) -> None:
        self.attach(run)
        average.add(run.model.gaussians)


class TakeAverage(Stage):
    """Replace the parameters by their averages; it belongs right behind the training.

    Steps that jump about a good model, at learning rates that are still large, lie around one that is better.
    """

    stage: Literal["take_average"] = "take_average"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "average"})
    takes: ClassVar[frozenset[str]] = frozenset({"average"})
    edits: ClassVar[bool] = True

    def run(self, run: Run) -> None:
        average.take(run.model.gaussians)
        run.refresh_filter()
