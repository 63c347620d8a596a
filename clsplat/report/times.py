"""Where the time of a training step goes on the device."""

from collections import defaultdict
from dataclasses import dataclass

from clsplat.training.run import Run


@dataclass(frozen=True)
class StageTime:
    """The mean time of one stage of a training step."""

    name: str
    milliseconds: float
    percent: float


@dataclass(frozen=True)
class Times:
    """The time of a step's stages on the device, averaged over the sampled steps."""

    samples: int
    milliseconds: float  # of all stages
    stages: list[StageTime]


def times(run: Run) -> Times | None:
    """Return the times; None where no step was sampled."""
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    whole = sum(totals.values())
    if whole == 0:
        return None
    return Times(len(samples), whole, [StageTime(name, ms, 100 * ms / whole) for name, ms in totals.items()])
