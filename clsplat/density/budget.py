"""Limit the number of Gaussians that an edit may leave, by the progress of training."""

from abc import abstractmethod
from dataclasses import dataclass

from clsplat.core.settings import Settings
from clsplat.density.edit import Edit


@dataclass(frozen=True)
class BudgetContext:
    """The progress of training at an edit."""

    share: float  # of the steps until the last edit that are done, 0 to 1
    edits: int  # still to come, this one included
    divisor: float  # downscale factor of the photographs


class Budget(Settings):
    """The number of Gaussians at which growth stops in an edit."""

    @property
    def statistics(self) -> set[str]:
        """Names of the statistics that it reads."""
        return set()

    @abstractmethod
    def limit(self, edit: Edit, context: BudgetContext, numbers: dict[str, float]) -> int:
        """Return the number; `numbers` persist from edit to edit, by name, and are in the checkpoint."""
