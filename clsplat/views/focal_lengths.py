"""Focal lengths that are learned with the model: a factor for each camera, which photographs of that camera share."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from clsplat.scene.view import View
from clsplat.schedule import Schedule, at_step
from clsplat.views.adam import adam_step

FOCALS = "focal_lengths"


@dataclass(frozen=True)
class FocalLengths:
    """The cameras of a dataset's views, and the rate at which the logarithms of their factors are learned.

    A factor is of both focal lengths.  Its logarithm lies among the numbers that a run keeps, as
    focal_lengths/CAMERA/log with its moments, and is 0 before the first step.
    """

    cameras: Mapping[str, str]  # names of cameras, that of the first view with the same one, by those of other views
    rate: Schedule = 0.0

    @classmethod
    def of(cls, views: Sequence[View], rate: Schedule = 0.0) -> "FocalLengths":
        """Return those of all views of a dataset, as it was read: equal lenses, or equal pinhole cameras, are one."""
        first: dict[object, str] = {}
        return cls({view.name: first.setdefault(view.lens or view.camera, view.name) for view in views}, rate)

    def _key(self, view: str) -> str:
        return f"{FOCALS}/{self.cameras.get(view, view)}/log"

    def factor(self, numbers: Mapping[str, float], view: str) -> float:
        """Return what the focal lengths of a view are multiplied by: 1 where nothing has been learned of its camera."""
        return math.exp(numbers.get(self._key(view), 0.0))

    def learned(self, numbers: Mapping[str, float]) -> list[str]:
        """Return the names of the cameras that have a number."""
        return [camera for camera in dict.fromkeys(self.cameras.values()) if self._key(camera) in numbers]

    def update(self, numbers: dict[str, float], view: str, derivative: float, step: int) -> None:
        """Change the number of a view's camera by Adam; derivative: by the logarithm of the factor."""
        if rate := at_step(self.rate, step):
            key = self._key(view)
            adam_step(numbers, {key: numbers.get(key, 0.0)}, {key: derivative}, rate)


NO_FOCALS = FocalLengths({})
