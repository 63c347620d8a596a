"""Whole runs with rules of shipped recipes: what they decide, and that runs resume and repeat to the bit."""

import json

import pytest

from tests.test_training import train

pytestmark = pytest.mark.slow

PRUNE = "{type: prune_faint, opacity_below: 0.005}"
SADDLE = "{type: split_saddle, gradient_above: 1.0e-5, distance: 0.5, shrink: 1.6}"
CROWDED = "{type: clone_crowded, gradient_above: 1.0e-5, size_below: 0.1, ratio_above: 2.0, cells: 3, extremes: 8}"
CASES = {  # what acts -> settings
    "split_saddle": (f"densify.rules=[{SADDLE}, {PRUNE}]",),
    "clone_crowded": (f"densify.rules=[{CROWDED}, {{type: clone}}, {PRUNE}]",),
}


@pytest.mark.parametrize("name", CASES)
def test_runs_resume_and_repeat_to_the_bit(tiny_scene, tmp_path, name):
    settings = (*CASES[name], "optimize.checkpoint.keep=9", "optimize.log_every=5")
    first = train(tiny_scene, tmp_path / "first", *settings)
    whole = (first.out / "point_cloud.ply").read_bytes()
    lines = [json.loads(line) for line in (first.out / "metrics.jsonl").read_text().splitlines()]
    edits = [line for line in lines if line["kind"] == "densify"]
    assert sum(edit["grown"][name] for edit in edits) > 20
    again = train(tiny_scene, tmp_path / "again", *settings)
    assert (again.out / "point_cloud.ply").read_bytes() == whole
    for step in (30, 40, 50):
        (again.out / "checkpoints" / f"step_{step:06d}.npz").unlink()
    (again.out / "point_cloud.ply").unlink()
    resumed = train(tiny_scene, tmp_path / "again", *settings, resume=True)
    assert (resumed.out / "point_cloud.ply").read_bytes() == whole
    assert resumed.records.read("densify") == first.records.read("densify")
