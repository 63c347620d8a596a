"""A part of space, such as the one in which Gaussians grow."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.settings import Settings

Corner = Annotated[list[float | None], Field(min_length=3, max_length=3)]


class Box(Settings):
    """A box with its lower faces and without its upper ones, so that boxes side by side share no point."""

    low: Corner = Field(default=[None, None, None])
    """Lowest x, y and z, scene units; null: none."""
    high: Corner = Field(default=[None, None, None])
    """First x, y and z beyond it, scene units; null: none."""

    @model_validator(mode="after")
    def _with_room(self) -> "Box":
        for name, low, high in zip("xyz", self.low, self.high, strict=True):
            if low is not None and high is not None and not low < high:
                raise ValueError(f"expected 'low' below 'high' on each axis, got {low:g} and {high:g} for {name}")
        return self

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points, [N, 3] scene units, lie in it, [N]; one that is not a number lies nowhere."""
        found = ~np.isnan(points).any(axis=1)
        for axis, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            values = points[:, axis].astype(np.float64)
            found &= (True if low is None else values >= low) & (True if high is None else values < high)
        return np.asarray(found)
