"""3DGS-MCMC (Kheradmand et al. 2024): relocation of faint Gaussians, and noise on the means."""

from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import NonNegative, Positive, at_step
from clsplat.density.edit import Edit, Rule
from clsplat.gaussians.gaussians import Gaussians
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled

MOST = 50  # rows in one place that eqs. 8 and 9 are applied for, as published
WEIGHTS = 2**24  # steps of an opacity as a weight: whole numbers, whose sums are exact


class Relocate(Rule):
    """Move faint Gaussians to opaque ones, drawn by opacity; those that share a place keep its opacity (eqs. 8 and 9).

    As many more are drawn as the growth asks for, up to the limit of the edit (`max_gaussians`, `budget`, memory).
    """

    type: Literal["relocate"] = "relocate"
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below", "growth"})

    opacity_below: Positive = 0.005
    """Opacity of Gaussians that are moved; by step."""
    growth: Annotated[float, Field(ge=1)] = 1.05
    """Number of Gaussians after an edit by the number before."""

    def mark(self, edit: Edit) -> None:
        gaussians, rows = edit.gaussians, edit.rows()
        logit, log_scales = (gaussians.get(name).astype(np.float64) for name in ("logit_opacity", "log_scales"))
        opacity = np.minimum(1 / (1 + np.exp(-logit[:, 0])), 1 - 1e-7)
        faint = opacity < edit.at(self.opacity_below)
        weights = np.where(faint | (rows != 1), 0, opacity * WEIGHTS).astype(np.uint64)
        if not weights.any():
            return
        more = min(int(self.growth * len(rows)) - len(rows), np.inf if edit.room is None else edit.room)
        drawn = systematic(weights, max(0, int(more) + int(rows[faint].sum())), edit.random())
        sources = np.flatnonzero(drawn)
        opacities, factors = divided(
            opacity[sources], np.minimum(drawn[sources] + 1, MOST), edit.at(self.opacity_below)
        )
        logits, log_scales = (
            np.log(opacities / (1 - opacities))[:, None],
            log_scales[sources] + np.log(factors)[:, None],
        )
        for copies in np.unique(drawn[sources] + 1):  # not where a later rule or the limit lets a source stay alone
            alike = drawn[sources] + 1 == copies
            for name, values in (("logit_opacity", logits), ("log_scales", log_scales)):
                edit.set_children(name, sources[alike], np.repeat(values[alike, None], copies, axis=1))
        edit.zero_moments(sources)
        edit.choose(faint | (drawn > 0), copies=np.where(faint, 0, drawn + 1), kept=1)


def systematic(weights: NDArray[np.uint64], draws: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Return how often each item is drawn, [N]: the expected number, to the next whole one below or above.

    Places at equal distances, moved by one random number, on the line of all weights, in whole numbers.
    """
    ends = np.cumsum(weights)
    total = int(ends[-1])
    step, rest = divmod(total, max(draws, 1))
    index, start = np.arange(draws, dtype=np.uint64), np.uint64(random.integers(0, total))
    places = index * np.uint64(step) + (index * np.uint64(rest) + start) // np.uint64(max(draws, 1))
    return np.diff(np.searchsorted(places, ends, side="left"), prepend=0)


def divided(
    opacity: NDArray[np.float64], rows: NDArray[np.integer], lowest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the opacity of each of so many equal Gaussians in one place, and the factor of their scales (eqs. 8, 9).

    Together they have the opacity of one at its center, and its integral along a line.
    """
    new = np.clip(1 - (1 - opacity) ** (1 / rows), lowest, 1 - 1e-6)
    series = sum(scipy.special.comb(rows, j) * (-1.0) ** (j - 1) * new**j / np.sqrt(j) for j in range(1, MOST + 1))
    return new, opacity / series


# Noise on the means (3DGS-MCMC, Kheradmand et al. 2024).


class AddNoise(Scheduled):
    """Move each mean at random along the axes of its Gaussian, by their variances; opaque Gaussians stay.

    The noise is rate / (1 + exp(-100 (opacity_below - opacity))) Σ n / extent, with n three normal numbers, and none
    0.1 above that opacity.  The division by the extent makes it the same in every unit of length.
    """

    stage: Literal["add_noise"] = "add_noise"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "opacity_below"})

    rate: NonNegative = 80.0
    """Size of the noise; published: 5e5 times the rate of the means; by step."""
    opacity_below: Positive = 0.005
    """Opacity at which the noise is half as large; by step."""

    def run(self, run: Run) -> None:
        rate, below = at_step(self.rate, run.step) / run.scene.extent, at_step(self.opacity_below, run.step)
        add_noise(run.model.gaussians, rate, below, run.seed, run.step)


def add_noise(gaussians: Gaussians, rate: float, opacity_below: float, seed: int, step: int) -> None:
    """Move each mean by rate / (1 + exp(-100 (opacity_below - opacity))) Σ n, n three normal numbers (Kheradmand et
    al. 2024).  rate: scene units⁻¹.
    """
    gaussians.device.program("noise.cl").add_noise(
        items=gaussians.count,
        means=gaussians["means"],
        quats=gaussians["quats"],
        log_scales=gaussians["log_scales"],
        logit_opacity=gaussians["logit_opacity"],
        rate=rate,
        opacity_below=opacity_below,
        seed=seed,
        step=step,
        stride=gaussians.capacity,
        count=gaussians.count,
    )
