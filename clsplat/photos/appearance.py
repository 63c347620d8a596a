"""Store parameters per photograph in the scalars of a run, and update them with Adam."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import write_text
from clsplat.core.reading import read_json
from clsplat.opencl.device import constants

Floats = NDArray[np.float64]
LUMINANCE = np.array([0.299, 0.587, 0.114])  # BT.601
IDENTITY = np.eye(3, 4)
MEANING = "a color c of the model (red, green, blue) is min(1, E c + b) in the photo"

# Adam for scalars in a dictionary that also contains their moments and is saved in checkpoints.

ADAM = constants("adam.h")
Scalars = dict[str, float]


def adam_step(scalars: Scalars, values: Mapping[str, float], gradients: Scalars, rate: float) -> None:
    """Update scalars with Adam (Kingma and Ba 2015), with the same constants as for the Gaussians.

    values: the current values by name.  `scalars` also contains NAME/updates, NAME/moment1, and NAME/moment2.
    """
    beta1, beta2 = ADAM["BETA1"], ADAM["BETA2"]
    for name, value in values.items():
        state_keys = [f"{name}/{suffix}" for suffix in ("updates", "moment1", "moment2")]
        updates, moment1, moment2 = (scalars.get(key, 0.0) for key in state_keys)
        updates, gradient = updates + 1, gradients[name]
        moment1 = beta1 * moment1 + (1 - beta1) * gradient
        moment2 = beta2 * moment2 + (1 - beta2) * gradient**2
        denominator = math.sqrt(moment2 / (1 - beta2**updates)) + ADAM["EPSILON"]
        scalars[name] = value - rate * moment1 / (1 - beta1**updates) / denominator
        scalars |= dict(zip(state_keys, (updates, moment1, moment2), strict=True))


# A table with one row of parameters per photograph; a step updates the row of its photograph.


@dataclass(frozen=True)
class ViewTable:
    """The layout of a table in a dictionary of scalars, with one row per view.  Missing scalars count as 0."""

    name: str
    views: tuple[str, ...]  # names of the training views, each once
    columns: tuple[str, ...]
    is_centered: bool = True  # whether the mean of each column over the views stays 0

    def keys(self, view: str) -> list[str]:
        """Return the keys of a view's row in the dictionary, one per column."""
        return [f"{self.name}/{view}/{column}" for column in self.columns]

    def row(self, scalars: Mapping[str, float], view: str) -> Floats:
        """Return the row of a view, [columns]."""
        return np.array([scalars.get(key, 0.0) for key in self.keys(view)])

    def is_in(self, scalars: Mapping[str, float]) -> bool:
        """Return whether the dictionary contains the table."""
        return self.keys(self.views[0])[0] in scalars

    def begin(self, scalars: dict[str, float], rows: Mapping[str, Floats]) -> None:
        """Set each view's row to its values in `rows`, or to 0 if it has none; then center the table."""
        for view in self.views:
            values = rows.get(view, np.zeros(len(self.columns)))
            scalars.update(zip(self.keys(view), map(float, values), strict=True))
        self.center(scalars)

    def update(self, scalars: dict[str, float], view: str, gradient: Floats, rate: float) -> None:
        """Update a view's row with Adam, which counts updates for each row; then center the table if `is_centered`."""
        values = {key: scalars.get(key, 0.0) for key in self.keys(view)}
        adam_step(scalars, values, dict(zip(values, map(float, gradient), strict=True)), rate)
        if self.is_centered:
            self.center(scalars)

    def center(self, scalars: dict[str, float]) -> None:
        """Subtract from each column its mean over the views.  The sum is exact, so it is independent of their order."""
        for column in zip(*map(self.keys, self.views), strict=True):
            mean = math.fsum(scalars[key] for key in column) / len(column)
            for key in column:
                scalars[key] -= mean

    def write(self, path: Path, rows: Mapping[str, Floats]) -> None:
        """Write rows, keyed by view name, to a side file.  Raises OutputError."""
        photographs = {view: dict(zip(self.columns, map(float, row), strict=True)) for view, row in rows.items()}
        write_text(path, json.dumps({"photographs": photographs}, indent=1) + "\n")

    def read(self, path: Path) -> dict[str, Floats]:
        """Read the rows of a side file, keyed by view name.  Return an empty dictionary if the file does not exist.

        Raises DataError if the file is damaged.
        """
        if not path.is_file():
            return {}
        try:
            items = read_json(path, f"{self.name} of photos")["photographs"].items()
            rows = {view: np.array([float(row[column]) for column in self.columns]) for view, row in items}
        except (AttributeError, KeyError, TypeError, ValueError):
            rows = {"": np.array([np.nan])}
        if not all(np.isfinite(row).all() for row in rows.values()):
            raise DataError(
                f"{path}: expected {len(self.columns)} finite numbers for each photo; train again, or remove the file"
            )
        return rows
