"""One look at a dataset: pieces, facts, findings and the verdict."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clsplat.inspect.finding import Finding
from clsplat.inspect.findings import findings, trainable, verdict
from clsplat.inspect.parts import read_parts
from clsplat.inspect.survey import Facts, survey
from clsplat.scene.parts import Parts


@dataclass(frozen=True)
class Inspection:
    """The pieces of a dataset, the facts about them and the findings."""

    parts: Parts
    facts: Facts
    findings: list[Finding]

    @classmethod
    def of(cls, path: Path) -> "Inspection":
        """Inspect the dataset in a folder.  Raises DataError only where there is no such folder."""
        parts = read_parts(path)
        facts = survey(parts)
        return cls(parts, facts, findings(facts))

    @property
    def trainable(self) -> bool:
        return trainable(self.findings)

    @property
    def verdict(self) -> str:
        return verdict(self.findings)

    def data(self) -> dict[str, Any]:
        """Return verdict, findings and facts as plain data for JSON."""
        return {
            "verdict": self.verdict,
            "trainable": self.trainable,
            "findings": [{"level": finding.level, "text": finding.text} for finding in self.findings],
            "facts": asdict(self.facts),
        }
