"""Map the timestamps of a dynamic scene to [0, 1], and group its views by camera."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.core.errors import DataError, first_few
from clsplat.scene.view import View


@dataclass(frozen=True)
class Clock:
    """The first and last timestamp of a scene, in the unit of its files."""

    first: float
    last: float

    def normalize_points(self, path: object, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the timestamps of the points of the file `path` as times in [0, 1], in the same shape.

        Raises DataError if some are outside the range of the scene by more than 0.1 % of it or a rounding error.
        """
        span, max_time = self.last - self.first, max(abs(self.first), abs(self.last))
        slack = max(1e-3 * span, float(np.finfo(np.float32).eps) * max_time)
        low, high = (float(values.min()), float(values.max())) if values.size else (self.first, self.last)
        if low < self.first - slack or high > self.last + slack:
            raise DataError(
                f"{path}: its points have times from {low:.9g} to {high:.9g}, but the frames have times from "
                f"{self.first:.9g} to {self.last:.9g}; use the unit of the frames, or remove the property `time` of "
                "the points"
            )
        return self(values)

    def __call__(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return timestamps as times in [0, 1], in the same shape; timestamps outside of the range are clamped."""
        return np.clip((np.asarray(values, np.float64) - self.first) / (self.last - self.first), 0, 1)


def make_clock(path: object, timestamps: Sequence[tuple[str, float | None]]) -> Clock | None:
    """Return the clock of a dataset from the names and timestamps of its frames, or None without timestamps.

    Raises DataError when only some frames have a timestamp, or when all timestamps are equal.
    """
    values = [value for _, value in timestamps if value is not None]
    if not values:
        return None
    if names := [name for name, value in timestamps if value is None]:
        raise DataError(
            f"{path}: {len(names)} of {len(timestamps)} frames have no `time`: {first_few(names)}; "
            "add the missing times, or remove all times for a static scene"
        )
    first, last = min(values), max(values)
    if not (math.isfinite(last - first) and last > first):
        raise DataError(
            f"{path}: all {len(values)} frames have the time {first:g}; expected at least two times: export the file "
            "with its times, or remove `time` for a static scene"
        )
    return Clock(first, last)


def distinct_times(views: Iterable[View]) -> list[float]:
    """Return the distinct times of views, ascending; empty for a static scene."""
    return sorted({view.time for view in views if view.time is not None})


def camera_key(view: View) -> bytes:
    """Return a key of the pose, the camera and the size of a view, equal for all views of a fixed camera."""
    return view.world_to_camera.tobytes() + repr((view.camera, view.downscale)).encode()


def group_by_camera(views: Sequence[View]) -> list[list[View]]:
    """Return a list of the views of each fixed camera, in order of time."""
    groups: dict[bytes, list[View]] = {}
    for view in views:
        groups.setdefault(camera_key(view), []).append(view)
    return [sorted(group, key=lambda view: view.time or 0.0) for group in groups.values()]
