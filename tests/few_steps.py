"""A run of twelve steps, for the tests of checkpoints, of failures and of settings that change."""

from pathlib import Path

FEW = ("optimize.steps=12", "init.count=60", "optimize.log_every=5", "checkpoint.every=4", "densify.every=4")
FEW += ("densify.start=3", "optimize.evaluate.every=6", "reset_opacity.every=100")


def steps_saved(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "checkpoints").iterdir())
