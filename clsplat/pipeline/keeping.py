"""What a training that keeps its best model needs."""

from clsplat.errors import ConfigError
from clsplat.pipeline.file import PipelineFile
from clsplat.stages.optimize import Optimize
from clsplat.stages.training import Training


def check_keeping(settings: PipelineFile) -> None:
    """Raise ConfigError where a training has nothing to choose its model by, or one of several is a refit."""
    trainings = [stage for stage in settings.stages if isinstance(stage, Optimize)]
    if any(stage.keep == "best" for stage in trainings) and settings.scene.validation == 0:
        raise ConfigError("optimize.keep: best chooses by validation views; expected scene.validation: auto")
    if any(stage.refit for stage in trainings) and len(trainings) > 1:
        raise ConfigError(f"optimize.refit: expected one stage that trains, found {len(trainings)}")
    begun = 0  # global step
    for stage in settings.stages:
        if isinstance(stage, Optimize):
            stage.require_measured(begun)
            if stage.patience:  # nobody knows at which step the next one begins
                return
        begun += stage.steps if isinstance(stage, Training) else 0
