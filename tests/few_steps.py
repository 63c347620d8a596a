"""A run of twelve steps, for the tests of checkpoints, of failures and of settings that change."""

import shutil
from pathlib import Path

FEW = ("optimize.steps=12", "init.count=60", "optimize.log_every=5", "checkpoint.every=4", "densify.every=4")
FEW += ("densify.start=3", "optimize.evaluate.every=6", "reset_opacity.every=100")


def killed(finished: Path, out: Path) -> Path:
    """Copy a finished run of twelve steps as if it was killed before its last checkpoint."""
    shutil.copytree(finished, out)
    (out / "checkpoints" / "step_000012.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (out / name).unlink()
    return out


def steps_saved(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "checkpoints").iterdir())
