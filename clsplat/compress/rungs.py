"""The rungs of the ladder: a model with fewer and fewer Gaussians, each trained from the one before."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import ConfigError
from clsplat.gaussians.run_model import MODEL
from clsplat.pipeline.loading import Pipeline
from clsplat.tuning.tuning import Tuning

STAGES = ("init", "prune_least", "optimize", "take_average")  # of the recipe; what a rung writes is a PLY
PALETTE = "palette_sh"
# what trains the harmonics that a SOG holds, rounds them and other tables, and trains the last ones with them
VECTORS = ("reduce_sh", PALETTE, "optimize", "take_average", "share_palette", PALETTE)
FITTING = ("init", *VECTORS, "round_tables", "optimize", "take_average", "round_tables")
FITTED, SOG = "fitted", "model.sog"


@dataclass(frozen=True)
class Ladder:
    """Where rungs are trained, and with what."""

    out: Path
    tuning: Tuning

    def rung(self, keep: float, before: float) -> Path:
        """Prune from a share of the first model's Gaussians to another, and train; return the model's file.

        What an earlier call has finished is left alone, and what it has begun goes on.
        """
        if keep == 1:
            return self.tuning.source.file
        file = self.tuning.source.file if before == 1 else self.folder(before) / MODEL
        return self.tuning.trained(self.pipeline(file, keep / before), self.folder(keep))

    def folder(self, keep: float) -> Path:
        """Return the run folder of a rung."""
        return self.out / f"keep_{round(100 * keep):02d}"

    def fitted(self, file: Path, name: str, degree: int, quality: str) -> Path:
        """Train a rung with the harmonics of a SOG of it; return that SOG."""
        values = {"init.file": str(file.resolve()), "reduce_sh.degree": degree}
        values |= {f"stages.{place}.quality": quality for place, name in enumerate(FITTING) if name == PALETTE}
        pipeline = self.tuning.pipeline(FITTING, values, file=SOG, quality=quality)
        return self.tuning.trained(pipeline, self.out / FITTED / name, SOG)

    def pipeline(self, file: Path, keep: float) -> Pipeline:
        """Return the recipe as it is run: to prune a model file to a share of it."""
        return self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), "prune_least.keep": keep})


def checked_keeps(keeps: Sequence[float]) -> list[float]:
    """Return shares of the Gaussians, from many to few.  Raises ConfigError for what is no share, and for none."""
    ordered = sorted(set(keeps), reverse=True)
    if not ordered or not all(0.01 <= keep <= 1 for keep in ordered):
        raise ConfigError("--keep: expected shares of the Gaussians from 0.01 to 1, such as 1,0.7,0.5")
    if len({round(100 * keep) for keep in ordered}) < len(ordered):
        raise ConfigError("--keep: expected shares that differ by a hundredth")
    return ordered
