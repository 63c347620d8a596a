"""One step of Adam."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def adam_step(
    parameter: NDArray[Any],
    grad: NDArray[Any],
    moment1: NDArray[Any],
    moment2: NDArray[Any],
    step: int,
    rate: float,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """New parameter and moments; `step` counts from 1.  PyTorch's form: epsilon outside the root."""
    moment1 = beta1 * moment1 + (1 - beta1) * grad
    moment2 = beta2 * moment2 + (1 - beta2) * grad**2
    mean = moment1 / (1 - beta1**step)
    square = moment2 / (1 - beta2**step)
    return parameter - rate * mean / (np.sqrt(square) + epsilon), moment1, moment2
