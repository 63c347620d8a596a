"""What is wrong with a dataset, and its remedy."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """A fault of a dataset and its remedy.  With an error, training does not start."""

    level: Level
    fault: str
    remedy: str = ""

    @property
    def text(self) -> str:
        """Fault and remedy in one sentence."""
        return f"{self.fault}: {self.remedy}" if self.remedy else self.fault
