"""A table of numbers with a row for each photograph, and Adam of its own: a step changes the row of its photograph.

The numbers lie in the dictionary that a run keeps in its checkpoints, as NAME/PHOTOGRAPH/COLUMN, with their moments.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.views.adam import adam_step

Floats = NDArray[np.float64]


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
