"""What is behind everything in each step of a run's training, as `optimize.background` says."""

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.opencl.device import Array, Device
from clsplat.scene.quality import background_shows
from clsplat.scene.scene import Scene
from clsplat.training.run import Run

# The colour behind everything, where each step draws its own.


@dataclass(frozen=True)
class Backgrounds:
    """Uniform random colours, which depend on the seed and the step alone."""

    device: Device
    seed: int

    def at(self, step: int) -> Array:
        """Return the colour of a global step, [3] in [0, 1)."""
        return self.device.upload(np.random.default_rng([self.seed, step]).random(3, np.float32))


Behind = Literal["scene", "random", "transparent"]
LOG = logging.getLogger("clsplat")


def drawn_backgrounds(setting: Behind, run: Run) -> Backgrounds | None:
    """Return the colours that steps draw, or None where all have that of the scene.

    The photographs of the run keep their transparency for them.  Raises ConfigError for a model with a sky.
    """
    drawn = is_drawn(setting, run.scene)
    if setting == "transparent":
        now, what = ("random", "it") if drawn else ("scene", "none")
        LOG.info("background of the steps: %s, since %s shows behind photographs", now, what)
    if not drawn:
        return None
    if run.sky:
        raise drawn_beside_a_sky()
    run.photographs.keep_transparency()
    return Backgrounds(run.device, run.seed)


def is_drawn(setting: Behind, scene: Scene) -> bool:
    """Whether steps draw what is behind everything; `transparent`: where it shows behind photographs."""
    return setting == "random" or (setting == "transparent" and background_shows(scene))


def drawn_beside_a_sky() -> ConfigError:
    """The error of backgrounds that are to be drawn with a model that has a sky."""
    return ConfigError(
        "optimize.background: a drawn one is for models without a sky; leave model.background out, or set "
        "optimize.background to scene"
    )
