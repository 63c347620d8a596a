"""Limit the number of Gaussians after an edit by the progress of training."""

from abc import abstractmethod
from dataclasses import dataclass

from clsplat.core.settings import Settings
from clsplat.density.edit import Edit


@dataclass(frozen=True)
class BudgetContext:
    """The progress of training at an edit."""

    progress: float  # fraction of the steps until the last edit that are done, 0 to 1
    edits: int  # that remain, including this one
    divisor: float  # downscale factor of the photographs


class Budget(Settings):
    """A limit on the number of Gaussians, at which growth stops in an edit."""

    @property
    def statistics(self) -> set[str]:
        """Names of the statistics that the budget reads."""
        return set()

    @abstractmethod
    def limit(self, edit: Edit, context: BudgetContext, numbers: dict[str, float]) -> int:
        """Return the limit.  numbers: by name, kept between edits and in checkpoints."""
