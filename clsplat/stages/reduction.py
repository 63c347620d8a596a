"""Make a model smaller: crop it, prune Gaussians, reduce spherical harmonics."""

import logging
from collections.abc import Collection
from dataclasses import asdict
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.core.errors import EmptyRegionError
from clsplat.density.control import Box, keep_rows
from clsplat.density.importance import SCORES, Score, select_largest
from clsplat.density.thresholds import UnitInterval
from clsplat.formats.splats import MAX_DEGREE, sh_coefficients
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage

LOG = logging.getLogger("clsplat")


class Crop(Stage):
    """Remove the Gaussians whose means are outside a box."""

    stage: Literal["crop"] = "crop"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True

    inside: Box
    """The box to keep."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        rows = np.flatnonzero(self.inside.shifted(run.scene.origin).contains(gaussians.get("means")))
        if not len(rows):
            raise EmptyRegionError(
                f"crop: none of the {gaussians.count:,} Gaussians is inside the box; use a larger box"
            )
        change = keep_rows(gaussians, rows, self.stage)
        run.refresh_filter()
        run.records.add(run.step, "densify", **asdict(change))
        LOG.info("%s Gaussians are inside the box and kept", f"{change.after:,} of {change.before:,}")


Fraction = Annotated[float, Field(gt=0, lt=1)]


def score_gaussians(run: Run, score: Score = "weight") -> NDArray[np.float64]:
    """Return the score of each Gaussian, [N], summed over the pixels of the training views.

    score: "weight" sums blend weights; the other scores sum squared derivatives of the image with respect to each
    Gaussian.
    """
    views = run.scene.split("train")
    renders = run.survey().render(run.status.counted(views, "views", len(views)))
    return SCORES[score](renders, run.model.gaussians.count).astype(np.float64)


class PruneLeast(Scheduled):
    """Remove the Gaussians that contribute least to the training views.

    The score of a Gaussian is a sum over all unmasked pixels of all training views.
    """

    stage: Literal["prune_least"] = "prune_least"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"keep", "remove", "score"})

    keep: Fraction | None = None
    """Fraction of the Gaussians to keep; give this or `remove`."""
    remove: Fraction | None = None
    """Fraction of the Gaussians to remove; give this or `keep`."""
    score: Score = "weight"
    """Sum of blend weights, or of squared derivatives of the image with respect to the Gaussian (Hanson et al.
    2025)."""

    @model_validator(mode="after")
    def _check_fraction(self) -> "PruneLeast":
        if (self.keep is None) == (self.remove is None):
            raise ValueError("set either 'keep' or 'remove' to a fraction of the Gaussians, not both")
        return self

    def frozen_parameters(self, run: Run) -> Collection[str]:
        return run.model.gaussians.trained

    def run(self, run: Run) -> None:
        gaussians, score = run.model.gaussians, score_gaussians(run, self.score)
        fraction = 1 - (self.remove or 0) if self.keep is None else self.keep
        rows = np.flatnonzero(select_largest(score, max(1, round(fraction * len(score)))))
        change = keep_rows(gaussians, rows, self.stage)
        run.refresh_filter()
        run.records.add(run.step, "densify", **asdict(change))
        lost_percent = 100 * (1 - score[rows].sum() / (score.sum() or 1))
        LOG.info(
            "%s Gaussians kept; the removed ones had %.2g %% of the total %s",
            f"{len(rows):,} of {len(score):,}",
            lost_percent,
            self.score,
        )


class ReduceSh(Scheduled):
    """Drop bands of spherical harmonics: all bands above a degree, and the least important of the remaining bands.

    The importance of a Gaussian's band is the mean square of its color over all directions, times the Gaussian's weight
    in the training views.  Bands dropped by `share` are set to zero, which compresses well; later training changes them
    again.
    """

    stage: Literal["reduce_sh"] = "reduce_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"share"})

    degree: Annotated[int, Field(ge=0, le=MAX_DEGREE)] = MAX_DEGREE
    """Highest degree to keep, for all Gaussians."""
    share: UnitInterval = 0
    """Fraction of all bands of all Gaussians to set to zero, starting with the least important bands."""

    def frozen_parameters(self, run: Run) -> Collection[str]:
        return ("sh_rest",)

    def run(self, run: Run) -> None:
        model, gaussians = run.model, run.model.gaussians
        gaussians.lower_sh_degree(self.degree)
        model.degree = min(model.degree, self.degree)
        if not self.share or not gaussians.sh_degree:
            return
        sh_rest = gaussians.get("sh_rest")
        energy = compute_band_energy(sh_rest) * score_gaussians(run)[:, None]
        is_dropped = ~select_largest(energy.ravel(), energy.size - round(self.share * energy.size))
        gaussians.set("sh_rest", np.where(expand_bands(is_dropped.reshape(energy.shape)), 0, sh_rest))
        if run.adam is not None:
            run.adam.reset_moments("sh_rest")
        LOG.info("%d of %d SH bands are zero", is_dropped.sum(), is_dropped.size)


def compute_band_energy(sh_rest: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean square of each band above 0 over the sphere, [N, degree].  Coefficients are [N, (K-1)*3].

    The basis is orthonormal: the mean square of a function is the sum of its squared coefficients divided by 4 pi.
    """
    squares = np.square(sh_rest.astype(np.float64)) / (4 * np.pi)
    return np.stack([squares[:, first:end].sum(axis=1) for first, end in _bands(sh_rest.shape[1])], axis=1)


def expand_bands(bands: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Repeat a flag per band, [N, degree], for each coefficient of the band, [N, (K-1)*3]."""
    widths = [3 * (2 * band + 3) for band in range(bands.shape[1])]
    return np.repeat(bands, widths, axis=1)


def _bands(columns: int) -> list[tuple[int, int]]:
    """Return the column range, (first, end), of each band above 0 in a table of SH with `columns` columns."""
    ends = [3 * (sh_coefficients(degree) - 1) for degree in range(MAX_DEGREE + 1)]
    return [(first, end) for first, end in pairwise(ends) if end <= columns]
