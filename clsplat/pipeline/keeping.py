"""What a training that keeps its best model needs."""

from clsplat.errors import ConfigError
from clsplat.pipeline.file import PipelineFile
from clsplat.stages.optimize import Optimize


def check_keeping(settings: PipelineFile) -> None:
    """Raise ConfigError where a training has nothing to choose its model by, or one of several is a refit."""
    trainings = [stage for stage in settings.stages if isinstance(stage, Optimize)]
    if any(stage.keep == "best" for stage in trainings) and settings.scene.validation == 0:
        raise ConfigError("optimize.keep: best chooses by validation views; expected scene.validation: auto")
    if trainings:
        trainings[0].require_measured(0)  # where a later one begins, the patience of this one decides
    if any(stage.refit for stage in trainings) and len(trainings) > 1:
        raise ConfigError(f"optimize.refit: expected one stage that trains, found {len(trainings)}")
