"""A run of twelve steps, for tests of checkpoints, failures, and changed settings."""

import hashlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.pipeline.loading import load
from clsplat.runs import opening, run_folder, runner
from clsplat.runs.failures import recording_failures
from clsplat.runs.state import RunState
from clsplat.training import archive
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

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


def write_status(folder: Path, **values: Any) -> None:
    now = StatusFile(folder).now.model_copy(update=values)
    (folder / "status.json").write_text(json.dumps(now.model_dump(exclude_none=True)))


def written(notes: dict, arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    archive.write(file, notes, arrays.items())
    return file.getvalue()


def crafted(path: Path, change: Callable[[dict, dict], None]) -> None:
    """Write a checkpoint again, with right checksums and other contents."""
    notes, arrays = archive.read(path)
    arrays = {name: array.copy() for name, array in arrays.items()}
    change(notes, arrays)
    path.write_bytes(written(notes, arrays))


TWO_DOZEN = "optimize.steps=24", "optimize.checkpoint.every=8", "optimize.checkpoint.keep=9", "optimize.log_every=2"


NO_PROCESS = 99999999  # no process has this number


def records(out: Path) -> list[dict]:
    """The lines of metrics.jsonl without times."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in ("ms", "cpu_seconds", "stages")} for line in lines]


def train(scene: Path, out: Path, *overrides: str, pipeline: str = "smoke", resume: bool = False) -> Run:
    checked = load(pipeline, [f"scene.path='{scene}'", *overrides])
    start: run_folder.Start = "resume" if resume else "new"
    with run_folder.open_run_folder(RunState.read(out), start, step=0) as status, recording_failures(status):
        run = opening.open_run(checked, out, None, start, status)
        runner.execute(checked, run, start, lambda progress: None)
    return run


ONE_CORE = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "CL_CONFIG_CPU_TBB_NUM_WORKERS": "1"}


def digest(out: Path) -> str:
    return hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()
