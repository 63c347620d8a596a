"""Noise on the means (3DGS-MCMC, Kheradmand et al. 2024)."""

from typing import ClassVar, Literal

from clsplat.density.control import add_noise
from clsplat.schedule import NonNegative, Positive, at_step
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run


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
