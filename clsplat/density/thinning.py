"""Rules that reduce the number of Gaussians (the refinement of Micro-splatting's second version, Lee et al.
2025b; thresholds and formulas are ours)."""

from typing import ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.density.edit import Edit, Rule
from clsplat.density.mixture import mass_of, merged
from clsplat.density.thresholds import Share
from clsplat.formats.splats import inverse_opacities
from clsplat.gaussians.tables import SH_C0
from clsplat.schedule import Positive

Floats = NDArray[np.float64]


class PruneUnimportant(Rule):
    """Remove a share of all Gaussians: those with the smallest opacity times geometric mean scale."""

    type: Literal["prune_unimportant"] = "prune_unimportant"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share"})

    share: Share = 0.05
    """Share of all Gaussians that is removed."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        score = opacity * np.exp(gaussians.get("log_scales").astype(np.float64).mean(axis=1))
        chosen = np.zeros(len(score), bool)
        chosen[np.argsort(score, kind="stable")[: int(self.share * len(score))]] = True
        edit.choose(chosen, copies=0, kept=0)


class MergeNeighbours(Rule):
    """Replace two mutual nearest neighbours, close and of like colour, by one Gaussian.

    It has the mean and covariance of their mixture and the mean of their colours, weighted by opacity times volume, and
    the opacity that keeps the sum of these weights.  The row of the heavier one stays, with its statistics and Adam's
    moments, except those of scales and rotation.
    """

    type: Literal["merge_neighbours"] = "merge_neighbours"
    grows: ClassVar[bool] = False
    rewrites: ClassVar[bool] = True
    reads_means: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"distance_below", "colour_below"})

    distance_below: Positive = 0.5
    """Largest distance, a share of the sum of their mean scales; by step."""
    colour_below: Positive = 0.05
    """Largest difference of a channel of the base colours, in [0, 1]; by step."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        names = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
        tables = {name: gaussians.get(name).astype(np.float64) for name in names}
        first, second = self._pairs(edit, tables)
        alone = edit.rows() == 1
        usable = alone[first] & alone[second]
        first, second = first[usable], second[usable]
        if not len(first):
            return
        for name, values in merged(tables, first, second).items():
            edit.set_rows(name, first, values)
        edit.zero_moments(first, ("log_scales", "quats"))  # which belong to other axes
        absorbed = np.zeros(gaussians.count, bool)
        absorbed[second] = True
        edit.choose(absorbed, copies=0, kept=0)

    def _pairs(self, edit: Edit, tables: dict[str, Floats]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of mutual nearest neighbours that may merge, the heavier one first."""
        means, mass = tables["means"], mass_of(tables)
        if len(means) < 2 or not np.isfinite(means).all():  # the next report ends the training
            return np.empty(0, np.int64), np.empty(0, np.int64)
        rows = np.arange(len(means))
        distances, found = scipy.spatial.cKDTree(means).query(means, k=2)
        other = np.where(found[:, 0] == rows, 1, 0)  # of two in one place, the row itself may come second
        distance, nearest = distances[rows, other], found[rows, other]
        mutual = (nearest[nearest] == rows) & (rows < nearest)
        size = np.exp(tables["log_scales"].mean(axis=1))
        close = distance < edit.at(self.distance_below) * (size + size[nearest])
        colour = SH_C0 * np.abs(tables["sh_base"] - tables["sh_base"][nearest]).max(axis=1)
        one = rows[mutual & close & (colour < edit.at(self.colour_below))]
        two = nearest[one]
        heavier = mass[one] >= mass[two]
        return np.where(heavier, one, two), np.where(heavier, two, one)
