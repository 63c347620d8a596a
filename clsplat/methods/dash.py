"""Fewer Gaussians for smaller photographs (DashGaussian, Chen et al. 2025); photos/detail.py has their sizes."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.core.schedule import Positive
from clsplat.density.budget import Budget, BudgetContext
from clsplat.density.edit import Edit


class Momentum(Budget):
    """Fewer Gaussians for smaller photographs, up to a number that growth itself finds (DashGaussian, Chen et al.
    2025).

    The number at the end is that of the start and a sum, which begins with `begin` times it.  At every edit the sum
    becomes `keep` of itself and the number of Gaussians that could grow, where that is more.  On the way, what is added
    is divided by the divisor of the photographs' size to the power 2 - t, with t the share of the steps that are done.
    An edit that has reached its number replaces what is pruned.
    """

    type: Literal["momentum"] = "momentum"
    training_keys: ClassVar[frozenset[str]] = frozenset(
        {"gaussians", "begin", "keep", "gradient_above", "most", "growth"}
    )

    gaussians: Annotated[int, Field(gt=0)] | None = None
    """Number at the end; without it, the one that growth finds."""
    begin: Annotated[float, Field(gt=0, le=1e6)] = 5.0
    """First value of the sum, as a multiple of the Gaussians at the start."""
    keep: Annotated[float, Field(ge=0, lt=1)] = 0.98
    """Share of the sum that stays from edit to edit."""
    gradient_above: Positive = 2.0e-4
    """Lowest mean of `screen_grad` of a Gaussian that could grow; by step."""
    most: Annotated[int, Field(gt=0)] = 1_000_000
    """Largest number of Gaussians that one edit adds to the sum."""
    growth: Annotated[float, Field(gt=0)] = 0.2
    """Largest share of the Gaussians that one edit adds."""

    @property
    def statistics(self) -> set[str]:
        return {"screen_grad"}

    def limit(self, edit: Edit, context: BudgetContext, numbers: dict[str, float]) -> int:
        count = edit.gaussians.count
        begin = numbers.setdefault("momentum/start", count)
        momentum = numbers.setdefault("momentum/sum", self.begin * begin)
        end = self.gaussians or begin + momentum
        target = end if context.edits == 1 else begin + (end - begin) / context.divisor ** (2 - context.share)
        eager = int((edit.stats.mean("screen_grad") >= edit.at(self.gradient_above)).sum())
        numbers["momentum/sum"] = max(momentum, float(int(self.keep * momentum + min(self.most, eager))))
        return min(max(count, int(target)), int(count * (1 + self.growth)))
