"""Runs that update the rows that each view sees."""

import pytest

from clsplat.formats.ply import write_ply
from clsplat.formats.table import read as read_ply
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow


def test_a_run_resumes_and_repeats_to_the_bit(tiny_scene, few_steps, tmp_path):
    """From Gaussians of which each view sees a part."""
    spread = read_ply(few_steps / "point_cloud.ply").parameters
    spread["means"][::2] *= 6
    write_ply(tmp_path / "spread.ply", spread, {})
    first = ("init.source=model", f"init.file='{tmp_path / 'spread.ply'}'", *FEW)
    seen = (*first, "optimize.update=seen", "optimize.checkpoint.keep=9")
    train(tiny_scene, tmp_path / "all", *first)
    train(tiny_scene, tmp_path / "seen", *seen)
    again = train(tiny_scene, tmp_path / "again", *seen).out
    whole = digest(tmp_path / "seen")
    assert digest(again) == whole
    assert digest(tmp_path / "all") != whole
    (again / "checkpoints" / "step_000012.npz").unlink()
    (again / "point_cloud.ply").unlink()
    train(tiny_scene, again, *seen, resume=True)
    assert digest(again) == whole
