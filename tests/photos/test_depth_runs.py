"""Training with depths: bitwise repetition and resume, and refusals."""

import json

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from tests.support.outdoor_scene import Yard, missing
from tests.support.runs import TWO_DOZEN, digest, train

pytestmark = pytest.mark.slow

DEPTH = "{type: inverse_depth, weight: [[0, 0.5], [20, 0.0]]}"
LOSSES = f"optimize.losses=[{{type: l1, weight: 0.8}}, {{type: dssim, weight: 0.2}}, {DEPTH}]"


def test_runs_resume_and_repeat_bit_for_bit(rng, tmp_path):
    """While the loss has weight, and after."""
    scene = Yard(rng).write(tmp_path / "scene")
    first = train(scene, tmp_path / "first", *TWO_DOZEN, LOSSES)
    again = train(scene, tmp_path / "again", *TWO_DOZEN, LOSSES)
    assert digest(again.out) == digest(first.out)
    plain = train(scene, tmp_path / "plain", *TWO_DOZEN)
    assert digest(plain.out) != digest(first.out)
    lines = [(run.out / "metrics.jsonl").read_text().splitlines() for run in (first, plain)]
    losses = [[row["loss"] for row in map(json.loads, text) if row["kind"] == "train"] for text in lines]
    assert losses[0][0] > losses[1][0] * 1.01, "it is part of the loss that is told"
    for step in (16, 24):
        (again.out / "checkpoints" / f"step_{step:06d}.npz").unlink()
    (again.out / "point_cloud.ply").unlink()
    assert digest(train(scene, tmp_path / "again", *TWO_DOZEN, LOSSES, resume=True).out) == digest(first.out)


def test_scene_without_observations_is_refused(tiny_scene, tmp_path):
    with pytest.raises(DataError, match="the loss 'inverse_depth' needs points with tracks"):
        train(tiny_scene, tmp_path / "run", *TWO_DOZEN, LOSSES)


def test_depth_loss_refuses_pose_optimization(rng, tmp_path):
    with pytest.raises(ConfigError, match="'camera_optimizer' cannot be combined with inverse_depth"):
        train(
            Yard(rng).write(tmp_path / "scene"),
            tmp_path / "run",
            *TWO_DOZEN,
            LOSSES,
            "optimize.modules.camera_optimizer={start: 5}",
        )


def test_images_with_large_reprojection_errors_give_no_depths(rng, tmp_path):
    """The bits are those without the loss."""
    scene = missing(tmp_path / "scene", np.array([1.2, -0.9]), rng)
    with_loss, plain = train(scene, tmp_path / "loss", *TWO_DOZEN, LOSSES), train(scene, tmp_path / "plain", *TWO_DOZEN)
    assert digest(with_loss.out) == digest(plain.out)
