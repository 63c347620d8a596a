"""Whole runs in which training views omit their least important Gaussians."""

import shutil

import numpy as np
import pytest

from clsplat.formats.table import read as read_ply
from clsplat.gaussians.gaussians import HIDDEN
from clsplat.methods.mini_splatting import find_useless
from clsplat.training import checkpoint
from tests.support.runs import train

pytestmark = pytest.mark.slow

STEPS = 24
HIDING = f"""
name: hiding
stages:
  - init: {{source: random, count: 1000, opacity: 0.3}}
  - optimize:
      steps: {STEPS}
      update: seen
      losses: [l1]
      during:
        - densify: {{every: 7, stop: 15, rules: [{{type: clone, gradient_above: 1.0e-9, size_below: 1}}]}}
        - hide_useless: {{every: 5, stop: 11, weight_per_view: 0.6}}
        - checkpoint: {{every: 1, keep: 99}}
  - export: {{file: point_cloud.ply}}
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    file = tmp_path_factory.mktemp("pipeline") / "hiding.yaml"
    file.write_text(HIDING)
    return str(file)


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory, pipeline):
    return train(tiny_scene, tmp_path_factory.mktemp("hiding") / "run", pipeline=pipeline)


def bits(path) -> np.ndarray:
    return checkpoint.load(path)[1][f"gaussians/{HIDDEN}"][:, 0].astype(int)


def test_resumed_run_has_the_same_bits(tiny_scene, tmp_path, pipeline, finished):
    whole = finished.out
    of_step = {int(path.stem.removeprefix("step_")): path for path in checkpoint.list_files(whole)}
    assert not bits(of_step[5]).any(), "an edit follows its step"
    assert bits(of_step[6]).any()
    assert (bits(of_step[11]) != bits(of_step[10])).any(), "a second look"
    expected = (whole / "point_cloud.ply").read_bytes()
    again = tmp_path / "again"
    shutil.copytree(whole, again)
    for path in checkpoint.list_files(again):
        if int(path.stem.removeprefix("step_")) > 8:
            path.unlink()
    (again / "point_cloud.ply").unlink()
    train(tiny_scene, again, pipeline=pipeline, resume=True)
    assert (again / "point_cloud.ply").read_bytes() == expected


def test_children_inherit_hidden_views(finished):
    of_step = checkpoint.list_files(finished.out)
    before, after = (next(path for path in of_step if path.stem.endswith(f"_{step:06d}")) for step in (14, 15))
    assert len(bits(after)) > len(bits(before))
    assert set(bits(after)) == set(bits(before))
    assert np.bincount(bits(after) > 0)[1] > np.bincount(bits(before) > 0)[1]


def test_hidden_gaussians_do_not_change(tiny_scene, tmp_path, pipeline):
    """With `update: seen`; what other views leave out changes with the rest."""
    out = train(tiny_scene, tmp_path / "run", "optimize.densify.every=999", pipeline=pipeline).out
    saved = {int(path.stem.removeprefix("step_")): checkpoint.load(path)[1] for path in checkpoint.list_files(out)}
    always = ~saved[11][f"gaussians/{HIDDEN}"][:, 0].astype(int)
    views = int(saved[11][f"gaussians/{HIDDEN}"].max()).bit_length()
    everywhere = (always & (2**views - 1)) == 0
    assert everywhere.any()
    moved = saved[STEPS]["gaussians/means"] != saved[11]["gaussians/means"]
    assert not moved[everywhere].any()
    assert moved[~everywhere].any()


def test_all_gaussians_are_drawn_after_training(finished):
    run = finished
    assert HIDDEN not in run.model.gaussians.tables
    assert len(read_ply(run.out / "point_cloud.ply").parameters["means"]) == run.model.gaussians.count
    assert find_useless(run.survey(), 0.6).any()
