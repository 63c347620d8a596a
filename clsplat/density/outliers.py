"""Rules for Gaussians that training photographs hardly hold: far outside of the scene, or wide on the screen."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.density.survey import WEIGHT, Survey
from clsplat.render.filters import AT_REST

DEVIATIONS = 3  # of a radius in pixels, cl_kernels/project.cl


class PruneFar(Rule):
    """Remove Gaussians that are far outside of the scene.

    The middle of the scene is the median of the means on each axis; its size is the median distance from there.  Brush
    has the number of sizes, and another size: a side of a box around most of the means.
    """

    type: Literal["prune_far"] = "prune_far"
    grows: ClassVar[bool] = False
    conflicts = AT_REST
    training_keys: ClassVar[frozenset[str]] = frozenset({"distance_above"})

    distance_above: Positive = 100
    """Distance from the middle, by the scene's size, above which a Gaussian is removed; by step."""

    def mark(self, edit: Edit) -> None:
        means = edit.gaussians.get("means").astype(np.float64)
        if not len(means):
            return
        distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
        edit.choose(distance > edit.at(self.distance_above) * np.median(distance), copies=0, kept=0)


def largest_on_screen(survey: Survey) -> NDArray[np.float64]:
    """Return the largest size of each Gaussian on the screen, its largest standard deviation as a share of the
    photograph's width, over the training photographs in which it has weight, [N]; 0 where it has none."""
    found = np.zeros(survey.count)
    for look in survey.looks(survey.views):
        size = look.radius().astype(np.float64) / DEVIATIONS / look.photograph.camera.width
        np.maximum(found, size, out=found, where=look.sum(WEIGHT) > 0)
    return found


class PruneWide(Rule):
    """Remove Gaussians that are large on the screen, in one training photograph or more: some are haze before its
    camera.

    Half the photograph is the limit of on-the-fly-nvs (Meuleman et al. 2025).  Plain walls and skies may be made of
    large ones, too: it belongs before steps that close the holes.
    """

    type: Literal["prune_wide"] = "prune_wide"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"size_above"})

    size_above: Positive = 0.5
    """Size on the screen above which a Gaussian is removed: largest standard deviation as a share of the photograph's
    width; by step."""

    def mark(self, edit: Edit) -> None:
        edit.choose(edit.survey.once(largest_on_screen) > edit.at(self.size_above), copies=0, kept=0)
