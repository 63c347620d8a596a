"""The record of what a run was started with, inputs.json, and its comparison when the run goes on."""

import json
import logging
from pathlib import Path

from clsplat.errors import ConfigError, DataError, shortened
from clsplat.files import write_text
from clsplat.names import INPUTS
from clsplat.reading import read_json
from clsplat.scene.identity import Identity
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def write_inputs(run: Run) -> None:
    """Write the identity of the run's scene into its folder.  Raises OutputError."""
    if run.identity:
        write_text(run.out / INPUTS, json.dumps(run.identity.data()) + "\n")


def require_same_inputs(run: Run) -> None:
    """Raise ConfigError, saying what changed, when the run was started with other photographs, cameras or points."""
    before = _read(run.out / INPUTS)
    digest = run.inputs_before or (before.digest if before else "")
    if not digest:
        LOG.warning("%s: missing or damaged; photographs that have changed go unnoticed", run.out / INPUTS)
    elif run.identity and run.identity.digest != digest:
        changes = ", ".join(run.identity.changes(before)) if before else ""
        changes = changes or f"{INPUTS} is missing or damaged, so what changed is not known"
        raise ConfigError(
            f"{run.scene.path}: not what the run was started with: {shortened(changes, 500)}; put that back, or "
            "begin anew: `clsplat run` with --restart or another --out"
        )


def _read(path: Path) -> Identity | None:
    try:
        return Identity.from_data(read_json(path))
    except (DataError, ValueError):
        return None
