"""What is behind everything in each step of a run's training, as `optimize.background` says."""

import logging
from typing import Literal

from clsplat.errors import ConfigError
from clsplat.scene.transparency import background_shows
from clsplat.training.run import Run
from clsplat.views.backgrounds import Backgrounds

Behind = Literal["scene", "random", "transparent"]
LOG = logging.getLogger("clsplat")


def drawn_backgrounds(setting: Behind, run: Run) -> Backgrounds | None:
    """Return the colours that steps draw, or None where all have that of the scene.

    The photographs of the run keep their transparency for them.  Raises ConfigError for a model with a sky.
    """
    if setting == "transparent":
        shows = background_shows(run.scene)
        setting = "random" if shows else "scene"
        LOG.info("background of the steps: %s, since %s shows behind photographs", setting, "it" if shows else "none")
    if setting == "scene":
        return None
    require_no_sky_behind(run.sky is not None)
    run.photographs.keep_transparency()
    return Backgrounds(run.device, run.seed)


def require_no_sky_behind(sky: bool) -> None:
    """Raise ConfigError where the model has a sky."""
    if sky:
        raise ConfigError(
            "optimize.background: a drawn one is for models without a sky; leave model.background out, or set "
            "optimize.background to scene"
        )
