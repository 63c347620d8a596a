"""Rules that split Gaussians where the photographs have detail, or when they are too large (Lee et al. 2025).

Both rules choose on the host, from tables and statistics: comparing Gaussians with each other is a line of NumPy there.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.edit import Edit, Rule
from clsplat.density.sampling import largest
from clsplat.density.statistics import SEEN, StatisticName
from clsplat.density.thresholds import PixelQuantile, Quantile, Share, Threshold
from clsplat.gaussians.tables import INTERVAL2
from clsplat.schedule import NonNegative, Positive, explained

BETA = 0.5  # Lee et al. 2025: a child's covariance is half its parent's


class Subdivide(Rule):
    """Base of rules that replace Gaussians by smaller ones, a limited share of them at a time."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"children", "beta", "at_most", "radius_above"})

    children: Annotated[int, Field(ge=2, le=8)] = 2
    """Number of Gaussians that replace one."""
    beta: Annotated[float, Field(gt=0, le=1)] = BETA
    """A child's covariance divided by its parent's."""
    at_most: Share = 0.05
    """Largest share of all Gaussians that one edit splits; those with the largest score come first."""
    radius_above: Annotated[float, Field(ge=0)] = 2.0
    """Smallest mean radius on the screen, three standard deviations, px."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_radius"}

    def subdivide(self, edit: Edit, candidates: NDArray[np.bool_], score: NDArray[np.float32]) -> None:
        """Split the candidates, [N], with the largest scores; those of earlier rules and small ones are left out."""
        candidates = candidates & (edit.rows() == 1) & (edit.stats.mean("screen_radius") >= self.radius_above)
        chosen = largest(candidates, score, int(self.at_most * len(candidates)))
        edit.choose(chosen, copies=self.children, kept=0, shrink=self.beta**0.5)


class SplitTextured(Subdivide):
    """Split Gaussians where the photographs are textured.

    With `gradient_above` 0, texture alone decides.  Above 0, the mean of `screen_grad` must reach it too; choose a
    threshold below that of the other rules.
    """

    type: Literal["split_textured"] = "split_textured"
    training_keys: ClassVar[frozenset[str]] = frozenset({"texture_above", "gradient_above"})

    texture: StatisticName = "texture"
    """Column whose mean is the texture."""
    texture_above: Threshold = PixelQuantile(quantile=0.8, of="pixels")
    """Lowest texture: a number by step, or a quantile."""
    gradient_above: NonNegative = 1.0e-4
    """Lowest mean of `screen_grad`; by step."""

    @property
    def statistics(self) -> set[str]:
        return {*super().statistics, self.texture, "screen_grad"}

    def mark(self, edit: Edit) -> None:
        texture, gradient = edit.stats.mean(self.texture), edit.stats.mean("screen_grad")
        above = edit.threshold(self.texture, self.texture_above)
        seen = edit.gaussians.get(SEEN)[:, 0] > 0
        candidates = seen & (texture >= above) & (gradient >= edit.at(self.gradient_above))
        self.subdivide(edit, candidates, texture)


class SplitOversized(Subdivide):
    """Split Gaussians whose covariance trace is larger than τ = 3 s².

    s is `rms_above` as a share of the extent, or a quantile of the rms scales, or, with `pixels`, the length of so many
    pixels at the nearest training view.
    """

    type: Literal["split_oversized"] = "split_oversized"
    training_keys: ClassVar[frozenset[str]] = frozenset({"rms_above"})

    rms_above: Annotated[Quantile | Positive, explained(", or {quantile}")] = 0.01
    """Smallest rms scale, a share of the scene's extent by step, or a quantile of all rms scales."""
    pixels: Annotated[float, Field(gt=0)] | None = None
    """Smallest rms scale in px of the nearest training view; replaces `rms_above`."""

    @property
    def tables(self) -> set[str]:
        return {INTERVAL2} if self.pixels else set()

    def mark(self, edit: Edit) -> None:
        rms = np.sqrt(np.exp(2 * edit.gaussians.get("log_scales")).mean(axis=1))
        if self.pixels:
            bound = self.pixels * np.sqrt(edit.gaussians.get(INTERVAL2)[:, 0])
        elif isinstance(self.rms_above, Quantile):
            bound = np.full_like(rms, np.quantile(rms, self.rms_above.quantile) if len(rms) else 0.0)
        else:
            bound = np.full_like(rms, edit.at(self.rms_above) * edit.scene_scale.extent)
        self.subdivide(edit, rms > bound, rms / np.maximum(bound, 1e-30))
