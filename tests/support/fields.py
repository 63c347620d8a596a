"""A run that trains a small field in few steps."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from clsplat.training import checkpoint
from tests.support.runs import ONE_CORE, train

SHAPE = "{near: 0.5, far: 9, coarse_samples: 16, fine_samples: 16, depth: 2, width: 32, skip: 0, color_width: 16}"


PIPELINE = f"""
name: field
scene: {{levels: 2}}
stages:
  - train_field:
      steps: 12
      field: {SHAPE}
      rays: 128
      photographs: 4
      rate: 2.0e-3
      warm_up: 2
      log_every: 4
      during:
        - evaluate: {{every: 6, split: test}}
        - checkpoint: {{every: 4}}
  - evaluate: {{split: test, downscales: [1, 2, 4]}}
  - export_field
  - render
  - report
"""


ALONE = """
import sys
from pathlib import Path
from tests.support.runs import train
train(Path(sys.argv[1]), Path(sys.argv[2]), pipeline=sys.argv[3])
"""


def bits(out: Path) -> str:
    """A hash of the field and its moments after the last step, of all renders and of the metrics of all sizes."""
    _, tables = checkpoint.load(checkpoint.list_files(out)[-1])
    parts = [tables[name].tobytes() for name in sorted(tables)]
    parts += [path.read_bytes() for path in sorted((out / "renders").rglob("*.png"))]
    parts += [json.dumps(json.loads((out / "metrics.json").read_text())["test"]).encode()]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def resumed(finished: Path, scene: Path, out: Path, pipeline: str) -> Path:
    """A run that was killed before its last checkpoint, and has gone on to its end."""
    shutil.copytree(finished, out)
    (out / "checkpoints/step_000012.npz").unlink()
    for name in ("metrics.json", "checksums.json"):
        (out / name).unlink()
    shutil.rmtree(out / "renders")
    train(scene, out, pipeline=pipeline, resume=True)
    return out


def train_single_threaded(scene: Path, out: Path, pipeline: str) -> Path:
    """A run with one thread."""
    command = [sys.executable, "-c", ALONE, scene, out, pipeline]
    subprocess.run(command, check=True, env={**os.environ, **ONE_CORE}, cwd=Path(__file__).parents[2])
    return out
