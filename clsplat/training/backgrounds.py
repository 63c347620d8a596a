"""What is behind everything in each step of a run's training, as `optimize.background` says."""

from typing import Literal

from clsplat.errors import ConfigError
from clsplat.training.run import Run
from clsplat.views.backgrounds import Backgrounds

Behind = Literal["scene", "random"]


def drawn_backgrounds(setting: Behind, run: Run) -> Backgrounds | None:
    """Return the colours that steps draw, or None where all have that of the scene.

    The photographs of the run keep their transparency for them.  Raises ConfigError for a model with a sky.
    """
    if setting == "scene":
        return None
    if run.sky:
        raise ConfigError("optimize.background: 'random' is for models without a sky; set model.background to null")
    run.photographs.keep_transparency()
    return Backgrounds(run.device, run.seed)
