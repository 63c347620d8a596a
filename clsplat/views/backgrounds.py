"""The colour behind everything, where each step draws its own."""

from dataclasses import dataclass

import numpy as np

from clsplat.opencl.device import Array, Device


@dataclass(frozen=True)
class Backgrounds:
    """Uniform random colours, which depend on the seed and the step alone."""

    device: Device
    seed: int

    def at(self, step: int) -> Array:
        """Return the colour of a global step, [3] in [0, 1)."""
        return self.device.upload(np.random.default_rng([self.seed, step]).random(3, np.float32))
