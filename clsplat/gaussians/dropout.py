"""Gaussians that one step of a training leaves out."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Dropout:
    """What one step leaves out: each Gaussian with a probability below 1, by (seed, step, row)."""

    probability: float
    seed: int
    step: int  # global

    @property
    def opacity_factor(self) -> float:
        """Factor of the opacities of the others, which keeps the mean opacity of a Gaussian (Park et al. 2025)."""
        return 1 / (1 - self.probability)
