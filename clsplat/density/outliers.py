"""Define rules that remove floaters: Gaussians far outside the scene, or large on the screen."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import WEIGHT, Survey
from clsplat.render.filters import AT_REST

DEVIATIONS = 3  # standard deviations in a radius in pixels (cl_kernels/project.cl)


class PruneFar(Rule):
    """Remove Gaussians that are far outside the scene.

    The center of the scene is the median of the means on each axis, and its size the median distance from there.  Brush
    uses the same factor, but defines the size as a side of the box around most means.
    """

    type: Literal["prune_far"] = "prune_far"
    grows: ClassVar[bool] = False
    conflicts = AT_REST
    training_keys: ClassVar[frozenset[str]] = frozenset({"distance_above"})

    distance_above: Positive = 100
    """Distance from the center, as a multiple of the scene's size, above which a Gaussian is removed; by step."""

    def mark(self, edit: Edit) -> None:
        means = edit.gaussians.get("means").astype(np.float64)
        if not len(means):
            return
        distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
        edit.choose(distance > edit.at(self.distance_above) * np.median(distance), copies=0, kept=0)


def largest_on_screen(survey: Survey) -> NDArray[np.float64]:
    """Return the largest size of each Gaussian on the screen over the training views that show it, [N]; 0 if none does.

    The size is the largest standard deviation as a fraction of the image width.
    """
    largest = np.zeros(survey.count)
    for view in survey.render(survey.views):
        size = view.radius().astype(np.float64) / DEVIATIONS / view.photograph.camera.width
        np.maximum(largest, size, out=largest, where=view.sum(WEIGHT) > 0)
    return largest


class PruneWide(Rule):
    """Remove Gaussians that are large on the screen in a training view; some of them are haze in front of the camera.

    The default, half the image, is the limit of on-the-fly-nvs (Meuleman et al. 2025).  Plain walls and skies may
    consist of large Gaussians, too, so train for more steps afterwards to close the holes.
    """

    type: Literal["prune_wide"] = "prune_wide"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"size_above"})

    size_above: Positive = 0.5
    """Size on the screen above which a Gaussian is removed: largest standard deviation relative to the image width;
    by step."""

    def mark(self, edit: Edit) -> None:
        edit.choose(edit.survey.cached(largest_on_screen) > edit.at(self.size_above), copies=0, kept=0)
