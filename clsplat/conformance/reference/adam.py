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
    rate: float | NDArray[Any],
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
    seen: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """New parameter and moments; `step` counts from 1.  PyTorch's form: epsilon outside the root.

    Rows that are not `seen`, [N], stay as they are.
    """
    first = beta1 * moment1 + (1 - beta1) * grad
    second = beta2 * moment2 + (1 - beta2) * grad**2
    mean = first / (1 - beta1**step)
    square = second / (1 - beta2**step)
    updated = parameter - rate * mean / (np.sqrt(square) + epsilon)
    if seen is None:
        return updated, first, second
    rows = seen.reshape(-1, *[1] * (grad.ndim - 1))
    return np.where(rows, updated, parameter), np.where(rows, first, moment1), np.where(rows, second, moment2)
