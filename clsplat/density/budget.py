"""How many Gaussians an edit may leave, from what the training has seen so far."""

from abc import abstractmethod
from dataclasses import dataclass

from clsplat.core.settings import Settings
from clsplat.density.edit import Edit


@dataclass(frozen=True)
class Moment:
    """The time of an edit."""

    share: float  # of the steps up to the end of edits
    edits: int  # that are left, with this one
    divisor: float  # of the photographs' size


class Budget(Settings):
    """The number of Gaussians at which growth stops in an edit."""

    @property
    def statistics(self) -> set[str]:
        """Columns that it reads."""
        return set()

    @abstractmethod
    def limit(self, edit: Edit, moment: Moment, numbers: dict[str, float]) -> int:
        """Return the number; `numbers` are kept from edit to edit, by name."""
