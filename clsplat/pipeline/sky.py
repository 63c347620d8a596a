"""What does not go together with a sky that a pipeline asks for."""

from clsplat.pipeline.choosing import as_asked
from clsplat.pipeline.file import PipelineFile
from clsplat.render.backdrops import Directions
from clsplat.stages.optimize import Optimize


def check_sky(settings: PipelineFile) -> None:
    """Raise ConfigError where poses are learned, or backgrounds drawn, beside colours by direction.

    A sky that `auto` may choose is left out there, by the run; what `choices` make of either is looked at then.
    """
    asked = as_asked(settings)
    if isinstance(asked.model.background, Directions):
        for stage in asked.stages:
            if isinstance(stage, Optimize):
                stage.check_beside_a_sky(drawn=stage.background == "random")
