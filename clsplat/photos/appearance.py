"""What is common to the colours of photographs, and tables of numbers with a row for each photograph."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import constants

Floats = NDArray[np.float64]
LUMINANCE = np.array([0.299, 0.587, 0.114])  # BT.601
IDENTITY = np.eye(3, 4)
MEANING = "a colour c of the model, red, green and blue, is min(1, E c + b) in the photograph"

# Adam on numbers by name, which lie in one dictionary with their moments, as a run keeps it in its checkpoints.

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


# A table of numbers with a row for each photograph, and Adam of its own: a step changes the row of its photograph.


@dataclass(frozen=True)
class ViewTable:
    """The names of a table, of its rows, and of its columns; each number is 0 before the first step."""

    name: str
    views: tuple[str, ...]  # names of the training views, each once
    columns: tuple[str, ...]

    def keys(self, view: str) -> list[str]:
        """Return the names of a row's numbers."""
        return [f"{self.name}/{view}/{column}" for column in self.columns]

    def row(self, numbers: Mapping[str, float], view: str) -> Floats:
        """Return a row, [columns]."""
        return np.array([numbers.get(key, 0.0) for key in self.keys(view)])

    def begun(self, numbers: Mapping[str, float]) -> bool:
        """Whether the dictionary holds the table."""
        return self.keys(self.views[0])[0] in numbers

    def begin(self, numbers: dict[str, float], rows: Mapping[str, Floats]) -> None:
        """Set every row, to 0 where none is given, then `centre`."""
        for view in self.views:
            values = rows.get(view, np.zeros(len(self.columns)))
            numbers.update(zip(self.keys(view), map(float, values), strict=True))
        self.centre(numbers)

    def update(self, numbers: dict[str, float], view: str, gradient: Floats, rate: float) -> None:
        """Change the row of a view by Adam, with a count of updates of its own, then `centre`."""
        values = {key: numbers[key] for key in self.keys(view)}
        adam_step(numbers, values, dict(zip(values, map(float, gradient), strict=True)), rate)
        self.centre(numbers)

    def centre(self, numbers: dict[str, float]) -> None:
        """Subtract from each column its mean over the views; the sum is exact, so that no order matters."""
        for column in zip(*map(self.keys, self.views), strict=True):
            mean = math.fsum(numbers[key] for key in column) / len(column)
            for key in column:
                numbers[key] -= mean
