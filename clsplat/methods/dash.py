"""Limit the number of Gaussians while images are small, as in DashGaussian (Chen et al. 2025).

`photos/detail.py` chooses the sizes of the images.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.core.schedule import Positive
from clsplat.density.budget import Budget, BudgetContext
from clsplat.density.edit import Edit


class Momentum(Budget):
    """Allow fewer Gaussians while images are small; growth determines the final number (DashGaussian, Chen et
    al. 2025).

    The final number is the initial number plus a momentum, which starts at `initial_momentum` times the initial number.
    Each edit raises the momentum to `keep` times itself plus the number of Gaussians that could grow, if that is more.
    During training, the increase is divided by d^(2 - t), with d the divisor of the image size and t the fraction of
    the steps that are done.  Edits at their limit still replace pruned Gaussians.
    """

    type: Literal["momentum"] = "momentum"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"gaussians", "initial_momentum", "keep", "gradient_above", "max_added", "growth"}
    )

    gaussians: Annotated[int, Field(gt=0)] | None = None
    """Final number of Gaussians; default: determined by the momentum."""
    initial_momentum: Annotated[float, Field(gt=0, le=1e6)] = 5.0
    """Initial momentum, as a multiple of the initial number of Gaussians."""
    keep: Annotated[float, Field(ge=0, lt=1)] = 0.98
    """Factor on the momentum from one edit to the next."""
    gradient_above: Positive = 2.0e-4
    """Smallest mean of `screen_grad` at which a Gaussian counts as able to grow."""
    max_added: Annotated[int, Field(gt=0)] = 1_000_000
    """Largest number of Gaussians that one edit adds to the momentum."""
    growth: Annotated[float, Field(gt=0)] = 0.2
    """Largest increase by one edit, as a fraction of the number of Gaussians."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_grad"}

    def limit(self, edit: Edit, context: BudgetContext, state: dict[str, float]) -> int:
        count = edit.gaussians.count
        initial = state.setdefault("momentum/start", count)
        momentum = state.setdefault("momentum/sum", self.initial_momentum * initial)
        final = self.gaussians or initial + momentum
        is_last, divisor = context.remaining_edits == 1, context.divisor ** (2 - context.progress)
        target = final if is_last else initial + (final - initial) / divisor
        candidates = int((edit.stats.mean("screen_grad") >= edit.evaluate(self.gradient_above)).sum())
        state["momentum/sum"] = max(momentum, float(int(self.keep * momentum + min(self.max_added, candidates))))
        return min(max(count, int(target)), int(count * (1 + self.growth)))
