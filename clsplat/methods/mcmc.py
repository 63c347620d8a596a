"""Relocate faint Gaussians and add noise to the means, as in 3DGS-MCMC (Kheradmand et al. 2024)."""

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

MAX_COPIES = 50  # largest number of copies of one Gaussian in eqs. 8 and 9, as published
WEIGHT_STEPS = 2**24  # opacities become integer weights, whose sums are exact


class Relocate(Rule):
    """Move faint Gaussians onto others, sampled with opacities as weights, and keep the opacity there (eqs. 8 and 9).

    `growth` adds Gaussians in the same way, up to the limit of the edit (`max_gaussians`, `budget`, memory).
    """

    type: Literal["relocate"] = "relocate"
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below", "growth"})

    opacity_below: Positive = 0.005
    """Opacity below which a Gaussian is moved."""
    growth: Annotated[float, Field(ge=1)] = 1.05
    """Number of Gaussians after an edit, divided by the number before."""

    def mark(self, edit: Edit) -> None:
        gaussians, rows = edit.gaussians, edit.row_counts()
        logit, log_scales = (gaussians.get(name).astype(np.float64) for name in ("logit_opacity", "log_scales"))
        opacity = np.minimum(1 / (1 + np.exp(-logit[:, 0])), 1 - 1e-7)
        min_opacity = edit.evaluate(self.opacity_below)
        is_faint = opacity < min_opacity
        weights = np.where(is_faint | (rows != 1), 0, opacity * WEIGHT_STEPS).astype(np.uint64)
        if not weights.any():
            return
        new_rows = min(int(self.growth * len(rows)) - len(rows), np.inf if edit.room is None else edit.room)
        draws = sample_systematically(weights, max(0, int(new_rows) + int(rows[is_faint].sum())), edit.random())
        sources = np.flatnonzero(draws)
        copies = draws[sources] + 1
        opacities, factors = divide_opacity(opacity[sources], np.minimum(copies, MAX_COPIES), min_opacity)
        logits = np.log(opacities / (1 - opacities))[:, None]
        log_scales = log_scales[sources] + np.log(factors)[:, None]
        for number in np.unique(copies):  # set_children has no effect if a later rule or the limit undoes the growth
            group = copies == number
            for name, values in (("logit_opacity", logits), ("log_scales", log_scales)):
                edit.set_children(name, sources[group], np.repeat(values[group, None], number, axis=1))
        edit.zero_moments(sources)
        edit.choose(is_faint | (draws > 0), copies=np.where(is_faint, 0, draws + 1), old_rows=1)


def sample_systematically(weights: NDArray[np.uint64], draws: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the number of times that systematic sampling draws each item, [N]: the expected number rounded down or up.

    With exact integer arithmetic, the function places `draws` equidistant points, shifted by one random number, on the
    cumulative weights.
    """
    ends = np.cumsum(weights)
    total = int(ends[-1])
    step, remainder = divmod(total, max(draws, 1))
    index, start = np.arange(draws, dtype=np.uint64), np.uint64(rng.integers(0, total))
    points = index * np.uint64(step) + (index * np.uint64(remainder) + start) // np.uint64(max(draws, 1))
    return np.diff(np.searchsorted(points, ends, side="left"), prepend=0)


def divide_opacity(
    opacity: NDArray[np.float64], rows: NDArray[np.integer], min_opacity: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the opacity of each of `rows` equal Gaussians at one mean, and the factor on their scales (eqs. 8, 9).

    Together they have the opacity of the original at its center and the same integral along a line.  The published code
    clips opacities after it has computed the scales; here, the scales belong to the clipped opacities.
    """
    child_opacity = np.clip(1 - (1 - opacity) ** (1 / rows), min_opacity, 1 - 1e-6)
    orders = range(1, MAX_COPIES + 1)
    series = sum(scipy.special.comb(rows, j) * (-1.0) ** (j - 1) * child_opacity**j / np.sqrt(j) for j in orders)
    return child_opacity, opacity / series


class AddNoise(Scheduled):
    """Add noise to the means, proportional to each Gaussian's covariance; opaque Gaussians do not move.

    The noise is rate / (1 + exp(-100 (opacity_below - opacity))) Σ n / extent, with n a standard normal vector; it is
    negligible if the opacity is 0.1 above `opacity_below`.  The published code multiplies by the extent; dividing by it
    makes the rate independent of the unit of length.
    """

    stage: Literal["add_noise"] = "add_noise"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "opacity_below"})

    rate: NonNegative = 80.0
    """Scale of the noise.  Published: 5e5 times the learning rate of the means, times the squared extent."""
    opacity_below: Positive = 0.005
    """Opacity at which the sigmoid factor of the noise is 1/2."""

    def run(self, run: Run) -> None:
        rate, max_opacity = at_step(self.rate, run.step) / run.scene.extent, at_step(self.opacity_below, run.step)
        add_noise(run.model.gaussians, rate, max_opacity, run.seed, run.step)


def add_noise(gaussians: Gaussians, rate: float, opacity_below: float, seed: int, step: int) -> None:
    """Add rate / (1 + exp(-100 (opacity_below - opacity))) Σ n to each mean; rate: scene units⁻¹."""
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
