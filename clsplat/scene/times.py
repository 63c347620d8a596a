"""The moments of a scene that moves: from the numbers of its files to [0, 1], and back to who saw them."""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.core.errors import DataError, first_few
from clsplat.scene.view import View

LOG = logging.getLogger("clsplat")
LEAST_SPAN = 0.01  # of the frames' times: points of several moments within less are perhaps of another unit


@dataclass(frozen=True)
class Clock:
    """The first and the last moment of a scene, in any unit."""

    first: float
    last: float

    def of_points(self, path: object, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the moments of points of a file as times in [0, 1], of the same shape.

        Raises DataError where some lie farther outside of the scene's than a file of single precision may be wrong.
        """
        span, largest = self.last - self.first, max(abs(self.first), abs(self.last))
        slack = max(1e-3 * span, float(np.finfo(np.float32).eps) * largest)
        least, most = (float(values.min()), float(values.max())) if values.size else (self.first, self.last)
        if least < self.first - slack or most > self.last + slack:
            raise DataError(
                f"{path}: its points have times from {least:.9g} to {most:.9g}; expected the unit of the frames, whose "
                f"times are {self.first:.9g} to {self.last:.9g}: write the points again, or without the property `time`"
            )
        if 0 < most - least < LEAST_SPAN * span:
            LOG.warning(
                "%s: its points have times from %.9g to %.9g, a small part of those of the frames, %.9g to %.9g: "
                "if their unit is another, write them again, or without the property `time`",
                *(path, least, most, self.first, self.last),
            )
        return self(values)

    def __call__(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return moments as times in [0, 1], of the same shape; what lies outside is brought to the nearer end."""
        return np.clip((np.asarray(values, np.float64) - self.first) / (self.last - self.first), 0, 1)


def make_clock(path: object, moments: Sequence[tuple[str, float | None]]) -> Clock | None:
    """Return the clock of a dataset from the places and the moments of all its frames, or None where it has none.

    Raises DataError where only some frames have a moment, or all have the same.
    """
    values = [value for _, value in moments if value is not None]
    if not values:
        return None
    if without := [where for where, value in moments if value is None]:
        raise DataError(
            f"{path}: {len(without)} of {len(moments)} frames have no `time`: {first_few(without)}; expected a time in "
            "every frame, or in none: add those, or remove the others for a scene that does not move"
        )
    first, last = min(values), max(values)
    if not (math.isfinite(last - first) and last > first):
        raise DataError(
            f"{path}: all {len(values)} frames have the time {first:g}; expected two moments at least: export the file "
            "with its times, or remove `time` for a scene that does not move"
        )
    return Clock(first, last)


def distinct_times(views: Iterable[View]) -> list[float]:
    """Return the different times of views, ascending; empty where the scene does not move."""
    return sorted({view.time for view in views if view.time is not None})


def camera_key(view: View) -> bytes:
    """Return what views of one camera have in common: pose, lens and size; names play no part."""
    return view.world_to_camera.tobytes() + repr((view.camera, view.downscale)).encode()


def group_by_camera(views: Sequence[View]) -> list[list[View]]:
    """Return views by the camera that took them, in order of time."""
    groups: dict[bytes, list[View]] = {}
    for view in views:
        groups.setdefault(camera_key(view), []).append(view)
    return [sorted(group, key=lambda view: view.time or 0.0) for group in groups.values()]
