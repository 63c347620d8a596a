"""Define budgets, which limit the number of Gaussians according to the progress of training."""

from abc import abstractmethod
from dataclasses import dataclass

from clsplat.core.settings import Settings
from clsplat.density.edit import Edit


@dataclass(frozen=True)
class BudgetContext:
    """The progress of training at an edit."""

    progress: float  # fraction of the steps up to the last edit that have been run, 0 to 1
    remaining_edits: int  # including this one
    divisor: float  # downscale factor of the photographs


class Budget(Settings):
    """Base class of limits on the number of Gaussians; an edit stops growth at the limit."""

    @property
    def statistics(self) -> set[str]:
        """The names of the statistics that the budget reads."""
        return set()

    @abstractmethod
    def limit(self, edit: Edit, context: BudgetContext, state: dict[str, float]) -> int:
        """Return the largest number of Gaussians after the edit.

        state: values by name, which the budget may change; they persist between edits and are in checkpoints.
        """
