"""A short test of kills: a run is killed during training, and its cell resumes from the checkpoint."""

import hashlib
from pathlib import Path

import pytest

from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Cell
from clsplat.sweeps.batch import prepare_cell
from clsplat.sweeps.cell import Scenes
from clsplat.sweeps.child import FILE, OUT, PYTHON
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import CellOptions, run_cell
from tests.support.runs import FEW

pytestmark = pytest.mark.slow

RUN = """
import os, signal, sys
from clsplat.training import checkpoint
save = checkpoint.save

def killed(run, *more):  # by whatever kills without a word, at a slot that does not depend on time
    begun_anew, path = run.step == 4, save(run, *more)
    if begun_anew:
        os.kill(os.getpid(), signal.SIGKILL)
    return path

checkpoint.save = killed
sys.argv = ["clsplat", "--attended", "run", sys.argv[1], "--out", sys.argv[2], "--resume"]
from clsplat.__main__ import main
main()
"""


def test_killed_run_resumes_to_the_same_bits(tiny_scene: Path, few_steps: Path, store: Store, options: CellOptions):
    """CLSPLAT_KILLS=20 kills workers, runs, drivers and schedulers, over six cells."""
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW])
    cell = prepare_cell(Cell("few", checked), Scenes(store.prepared), store).in_class("b")
    outcome = run_cell(cell, store, [PYTHON, "-c", RUN, FILE, OUT], options)
    assert outcome.state == "published", outcome.message
    ends = [event["exit_code"] for event in store.events() if event["event"] == "end"]
    begun = [event["from"] for event in store.events() if event["event"] == "start"]
    assert (ends, begun) == ([-9, 0], [None, "step_000004.npz"])
    models = [folder / "point_cloud.ply" for folder in (few_steps, store.folder(cell.key).result)]
    assert len({hashlib.sha256(model.read_bytes()).hexdigest() for model in models}) == 1
