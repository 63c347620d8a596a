"""Draw a random background color in each step."""

import logging
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.quality import has_visible_background
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class RandomBackground(TrainingModule):
    """Draw a uniform random background color in each step.  It depends only on the seed and the step."""

    conflicts: ClassVar[Mapping[str, str]] = {"sky": "both are the background"}
    optional_on_resume: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"when"})

    type: Literal["random_background"] = "random_background"
    when: Literal["always", "transparent"] = "always"
    """`transparent`: only if the photos have transparent pixels."""

    def is_active(self, scene: Scene | None = None) -> bool:
        return self.when == "always" or (scene is not None and has_visible_background(scene))

    def create_state(self, run: Run) -> ModuleState:
        if self.when == "transparent":
            LOG.info("training with a random background, since photos have transparent pixels")
        run.photographs.enable_transparency()
        return RandomBackgroundState(run.seed)


class RandomBackgroundState(ModuleState):
    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed = seed

    def before_render(self, step: TrainingStep) -> None:
        step.background = step.workspace.upload("random background", random_color(self.seed, step.number))


def random_color(seed: int, step: int) -> NDArray[np.float32]:
    """Draw the background color of a global step, [3] in [0, 1)."""
    return np.random.default_rng([seed, step]).random(3, np.float32)
