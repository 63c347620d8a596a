"""The color behind everything, where each step draws its own."""

import logging
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from clsplat.opencl.device import Array, Device
from clsplat.scene.quality import background_shows
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class RandomBackground(TrainingModule):
    """Draw the color behind everything in each step: uniform, by the seed and the step alone."""

    conflicts: ClassVar[Mapping[str, str]] = {"sky": "it is behind everything, and drawn colors would be too"}
    optional_on_resume: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"where"})

    type: Literal["random_background"] = "random_background"
    where: Literal["always", "transparent"] = "always"
    """transparent: only where the background shows behind photographs."""

    def is_active(self, scene: Scene | None = None) -> bool:
        return self.where == "always" or (scene is not None and background_shows(scene))

    def create_state(self, run: Run) -> ModuleState:
        if self.where == "transparent":
            LOG.info("background of the steps: random, since it shows behind photographs")
        run.photographs.keep_transparency()
        return _Drawing(run.device, run.seed)


class _Drawing(ModuleState):
    def __init__(self, device: Device, seed: int) -> None:
        super().__init__()
        self.device, self.seed = device, seed

    def before_render(self, step: TrainingStep) -> None:
        step.background = drawn_background(self.device, self.seed, step.number)


def drawn_background(device: Device, seed: int, step: int) -> Array:
    """Return the color of a global step, [3] in [0, 1)."""
    return device.upload(np.random.default_rng([seed, step]).random(3, np.float32))
