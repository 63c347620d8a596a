"""Adam on numbers by name, which lie in one dictionary with their moments, as a run keeps it in its checkpoints."""

import math
from collections.abc import Mapping

from clsplat.opencl.program import constants

ADAM = constants("adam.h")
ByNumber = dict[str, float]


def adam_step(numbers: dict[str, float], values: Mapping[str, float], gradients: ByNumber, rate: float) -> None:
    """Change some numbers by Adam (Kingma and Ba 2015), as the parameters of the Gaussians are changed.

    values: the numbers now, by name; beside each, `numbers` keeps NAME/updates, NAME/moment1 and NAME/moment2.
    """
    beta1, beta2 = ADAM["BETA1"], ADAM["BETA2"]
    for name, value in values.items():
        names = [f"{name}/{kept}" for kept in ("updates", "moment1", "moment2")]
        updates, moment1, moment2 = (numbers.get(kept, 0.0) for kept in names)
        updates, gradient = updates + 1, gradients[name]
        moment1 = beta1 * moment1 + (1 - beta1) * gradient
        moment2 = beta2 * moment2 + (1 - beta2) * gradient**2
        root = math.sqrt(moment2 / (1 - beta2**updates)) + ADAM["EPSILON"]
        numbers[name] = value - rate * moment1 / (1 - beta1**updates) / root
        numbers |= dict(zip(names, (updates, moment1, moment2), strict=True))
