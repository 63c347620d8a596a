"""The nearest visible points, and the near plane."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.pipeline.loading import load
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.scene.detect import read_scene
from clsplat.scene.quality import measure_scene, near_depth
from clsplat.scene.scene import Tracks
from tests.support.outdoor_scene import Yard


def test_each_training_view_counts_once(tiny_scene):
    scene = read_scene(tiny_scene)
    assert measure_scene(scene.downscaled(1, 2)).photograph_count == len(scene.split("train"))


def test_nearest_points_are_in_front_of_training_views(tiny_scene):
    """The depth that a hundredth of what they show is nearer than; what lies behind a camera does not count."""
    scene = read_scene(tiny_scene)
    trained, tested = scene.split("train")[:2], scene.split("test")[0]
    depths = [np.r_[-3.0, 1:102], np.array([-1, 1.5, 9, 9]), np.array([0.5])]
    positions, seen = [], {}
    for view, own in zip((*trained, tested), depths, strict=True):
        to_world = np.linalg.inv(np.vstack([view.world_to_camera, [0, 0, 0, 1]]))
        seen[view.name] = np.arange(len(own)) + sum(map(len, positions))
        positions.append(np.column_stack([0 * own, 0 * own, own, own**0]) @ to_world[:3].T)

    points = np.concatenate(positions)
    points[seen[trained[1].name][2:]] = [[np.inf], [np.nan]]  # of a damaged file

    def nearest(*views):
        tracks = Tracks(points, {view.name: seen[view.name] for view in views})
        return near_depth(replace(scene, tracks=tracks))

    assert nearest(*trained, tested) == pytest.approx(1.505), "of 102 points; one shows one alone"
    assert nearest(trained[0]) == pytest.approx(2), "one in a hundred may be mistaken"
    assert nearest(tested) is None
    assert near_depth(replace(scene, points=None)) is None


@pytest.mark.slow
@pytest.mark.parametrize(("near", "warned"), [(0.001, False), (3, True)])
def test_run_warns_of_points_in_front_of_the_near_plane(tmp_path, rng, caplog, near, warned):
    Yard(rng).write(tmp_path / "yard")
    pipeline = load("smoke", [f"scene.path='{tmp_path / 'yard'}'", f"model.near={near}"])
    describe(pipeline, RunState.read(tmp_path / "run"), None, "new")
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    messages = [message for message in warnings if "model.near" in message]
    assert len(messages) == warned
    assert all(f"model.near={near} scene units" in item and "set model.near to " in item for item in messages)
