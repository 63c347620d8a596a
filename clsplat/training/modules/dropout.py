"""Leave Gaussians out of a step."""

from dataclasses import replace
from typing import ClassVar, Literal

from clsplat.core.schedule import Probability, at_step
from clsplat.gaussians.gaussians import DropoutMask as Drawn
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run


class Dropout(TrainingModule):
    """Leave each Gaussian out of a step with a probability; for few photographs.

    The opacities of the others are divided by 1 less it (DropGaussian, Park et al. 2025).  Pictures and measurements
    leave none out.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"probability"})
    optional_on_resume: ClassVar[bool] = True

    type: Literal["dropout"] = "dropout"
    probability: Probability
    """By step, 0.9 at most."""

    def create_state(self, run: Run) -> ModuleState:
        return _Dropping(self, run.seed)


class _Dropping(ModuleState):
    def __init__(self, settings: Dropout, seed: int) -> None:
        super().__init__()
        self.settings, self.seed = settings, seed

    def before_render(self, step: TrainingStep) -> None:
        if probability := at_step(self.settings.probability, step.number):
            step.model = replace(step.model, dropout=Drawn(probability, self.seed, step.number))
