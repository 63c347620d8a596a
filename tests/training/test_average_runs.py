"""Whole runs that end with the average of their last steps, and that start from a hull."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat import Trainer
from clsplat.formats.splats import PARAMETERS
from clsplat.formats.table import read as read_ply
from clsplat.training import checkpoint
from clsplat.training.run import Run
from tests.support.runs import train
from tests.support.silhouettes import RADIUS, SIZE, ball, ring

pytestmark = pytest.mark.slow

STEPS = 30
AVERAGED = f"""
name: averaged
stages:
  - init: {{source: random, count: 1000, opacity: 0.3}}
  - optimize:
      steps: {STEPS}
      losses: [l1]
      during:
        - densify: {{every: 5, stop: 16, rules: [{{type: clone, gradient_above: 1.0e-9, size_below: 1}}]}}
        - average: {{every: 2, start: 16}}
        - checkpoint: {{every: 1, keep: 99}}
  - export: {{file: point_cloud.ply}}
"""


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    file = tmp_path_factory.mktemp("pipeline") / "averaged.yaml"
    file.write_text(AVERAGED)
    return str(file)


@pytest.fixture(scope="module")
def averaged(tiny_scene, tmp_path_factory, pipeline) -> Run:
    """A finished run; nothing is changed in it."""
    return train(tiny_scene, tmp_path_factory.mktemp("averaged") / "run", pipeline=pipeline)


def test_run_ends_with_the_average_of_the_added_steps(averaged):
    """Those at 18, 20, ... 28: no edit follows the last step."""
    run = averaged
    of_step = {int(path.stem.removeprefix("step_")): path for path in checkpoint.list_files(run.out)}
    actual = read_ply(run.out / "point_cloud.ply").parameters
    for name in PARAMETERS:
        steps = [checkpoint.load(of_step[step])[1][f"gaussians/{name}"].astype(float) for step in range(18, 30, 2)]
        np.testing.assert_allclose(actual[name], np.mean(steps, axis=0), rtol=0, atol=1e-5, err_msg=name)
    last = checkpoint.load(of_step[STEPS])[1]["gaussians/means"]
    assert np.abs(actual["means"] - last).max() > 1e-4, "it is not the last step"
    assert not [table for table in run.model.gaussians.tables if table.startswith("average/")]


def test_resumed_run_has_the_same_bits(tiny_scene, tmp_path, pipeline, averaged):
    whole = averaged.out
    expected = (whole / "point_cloud.ply").read_bytes()
    again = tmp_path / "again"
    shutil.copytree(whole, again)
    (again / "point_cloud.ply").unlink()
    train(tiny_scene, again, pipeline=pipeline, resume=True)
    assert (again / "point_cloud.ply").read_bytes() == expected
    for path in checkpoint.list_files(again):
        if int(path.stem.removeprefix("step_")) > 21:
            path.unlink()
    (again / "point_cloud.ply").unlink()
    train(tiny_scene, again, pipeline=pipeline, resume=True)
    assert (again / "point_cloud.ply").read_bytes() == expected


def test_training_continues_from_the_last_step(tiny_scene, tmp_path, pipeline, averaged):
    longer = train(tiny_scene, tmp_path / "longer", "optimize.steps=40", pipeline=pipeline).out
    run = shutil.copytree(averaged.out, tmp_path / "run")
    train(tiny_scene, run, "optimize.steps=40", pipeline=pipeline, resume=True)
    assert (run / "point_cloud.ply").read_bytes() == (longer / "point_cloud.ply").read_bytes()


def test_training_without_an_average_keeps_the_last_step(tiny_scene, tmp_path, pipeline, caplog):
    caplog.set_level("INFO", "clsplat")
    run = train(tiny_scene, tmp_path / "run", "optimize.average.start=30", pipeline=pipeline)
    last = checkpoint.load(checkpoint.list_files(run.out)[-1])[1]["gaussians/means"]
    np.testing.assert_array_equal(read_ply(run.out / "point_cloud.ply").parameters["means"], last)
    assert "average: training ended before averaging started" in caplog.text


def test_trainer_averages_after_its_last_step(tiny_scene, tmp_path, pipeline, averaged):
    trainer = Trainer(tiny_scene, pipeline)
    for _ in range(STEPS):
        trainer.step()
    trainer.model.save(tmp_path / "model.ply")
    assert (tmp_path / "model.ply").read_bytes() == (averaged.out / "point_cloud.ply").read_bytes()
    with pytest.raises(StopIteration):
        trainer.step()


def ball_scene(folder: Path, channels: int) -> Path:
    """A ball from eleven sides, and one side as the test, with alpha where there are four channels."""
    frames = []
    folder.mkdir()
    for view in ring(12):
        cv2.imwrite(str(folder / f"{view.name}.png"), ball(view)[:, :, [2, 1, 0, 3][:channels]])
        pose = np.linalg.inv(np.vstack([view.world_to_camera, [0, 0, 0, 1]])) * [1, -1, -1, 1]
        frames.append({"file_path": view.name, "transform_matrix": pose.tolist()})
    angle = 2 * math.atan(0.5 * SIZE / 150)
    for split, own in (("train", frames[:-1]), ("test", frames[-1:])):
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": own}))
    return folder


STILL = (
    "init.source=auto",
    "init.count=300",
    "optimize.steps=20",
    "optimize.densify.stop=1",
    "optimize.rates.means=1e-9",
)


def distances(run: Run) -> np.ndarray:
    return np.linalg.norm(read_ply(run.out / "point_cloud.ply").parameters["means"], axis=1)


def test_training_starts_on_the_hull(tmp_path, pipeline):
    """`transparent: hull` is for photographs with alpha; `auto` alone takes random points, as published."""
    scene = ball_scene(tmp_path / "scene", 4)
    actual = distances(train(scene, tmp_path / "hull", *STILL, "init.transparent=hull", pipeline=pipeline))
    assert np.abs(actual - RADIUS).max() < 0.1
    actual = distances(train(scene, tmp_path / "random", *STILL, pipeline=pipeline))
    assert np.abs(actual - RADIUS).max() > 0.5


def test_photographs_without_transparency_have_no_hull(tmp_path, pipeline, caplog):
    scene = ball_scene(tmp_path / "scene", 3)
    run = train(scene, tmp_path / "run", *STILL, "init.source=hull", pipeline=pipeline)
    assert "the visual hull has only 0 points; starting from random points" in caplog.text
    assert run.model.gaussians.count == 300
