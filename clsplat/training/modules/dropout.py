"""Drop random Gaussians in each step."""

from dataclasses import replace
from typing import ClassVar, Literal

from clsplat.core.schedule import Probability, at_step
from clsplat.gaussians.gaussians import DropoutMask
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run


class Dropout(TrainingModule):
    """Drop each Gaussian from a step with a given probability, to regularize scenes with few photographs.

    The opacities of the other Gaussians are divided by 1 - probability (DropGaussian, Park et al. 2025).  Renders and
    metrics use all Gaussians.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"probability"})
    optional_on_resume: ClassVar[bool] = True

    type: Literal["dropout"] = "dropout"
    probability: Probability
    """Probability of dropping a Gaussian, at most 0.9; may be scheduled."""

    def create_state(self, run: Run) -> ModuleState:
        return DropoutState(self, run.seed)


class DropoutState(ModuleState):
    def __init__(self, settings: Dropout, seed: int) -> None:
        super().__init__()
        self.settings, self.seed = settings, seed

    def before_render(self, step: TrainingStep) -> None:
        if probability := at_step(self.settings.probability, step.number):
            step.model = replace(step.model, dropout=DropoutMask(probability, self.seed, step.number))
