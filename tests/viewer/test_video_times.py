"""Timestamps of videos: one, a range, and at a fixed camera."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.scene.camera import Camera
from clsplat.scene.scene import make_scene
from clsplat.scene.view import View
from clsplat.viewer.video import camera_path
from clsplat.viewer.video.paths import nearest_view
from clsplat.viewer.video.plan import VideoRequest, parse_times, plan_video
from tests.support.camera_paths import write_camera_path
from tests.support.refusals import refusal

CAMERA = Camera(40, 30, 50.0, 50.0, 20.0, 15.0)


@pytest.fixture
def scene(tmp_path):
    """Eight cameras about the origin, of two moments each."""
    angles = np.arange(8) * np.pi / 4
    views = []
    for i, angle in enumerate(angles):
        view = View.looking_at([3 * np.cos(angle), 3 * np.sin(angle), 1], [0, 0, 0], [0, 0, 1], CAMERA)
        views += [replace(view, name=f"c{i}/{j}", time=float(j)) for j in range(2)]
    return make_scene(tmp_path, views, set(), None)


def plan_views(scene, path="ellipse", times=None, frames=5, moves=True):
    return plan_video(VideoRequest.parse(path, frames, None, None, times), scene, np.empty((0, 3)), moves).views


@pytest.mark.parametrize(
    ("given", "expected"),
    [(None, None), (0.5, (0.5, 0.5)), ("0.5", (0.5, 0.5)), ("0..1", (0, 1)), ((1, 0.5), (1, 0.5)), ("1..0", (1, 0))],
)
def test_times_are_one_or_two_timestamps(given, expected):
    assert parse_times(given) == expected


@pytest.mark.parametrize("given", ["", "a", "0..2", "-1", "nan", [0.1, 0.2, 0.3], "0.."])
def test_other_times_are_refused(given):
    with pytest.raises(ConfigError, match="expected a time from 0 to 1, or a range such as 0"):
        parse_times(given)


def test_time_advances_along_a_path_or_is_fixed(scene):
    assert [view.time for view in plan_views(scene)] == [0, 0.25, 0.5, 0.75, 1]
    assert [view.time for view in plan_views(scene, times="1..0.5", frames=3)] == [1, 0.75, 0.5]
    frozen = plan_views(scene, times=0.25)
    assert {view.time for view in frozen} == {0.25}
    assert len({view.position.tobytes() for view in frozen}) == 5


def test_fixed_camera_is_one_view_over_time(scene):
    views = plan_views(scene, "fixed")
    assert len({view.world_to_camera.tobytes() for view in views}) == 1
    assert [view.time for view in views] == [0, 0.25, 0.5, 0.75, 1]
    named = plan_views(scene, "fixed:c3/1")
    assert (named[0].world_to_camera == scene.views[7].world_to_camera).all()
    with pytest.raises(DataError, match="no photo is named 'c9/0'"):
        plan_views(scene, "fixed:c9/0")
    with pytest.raises(ConfigError, match="only `fixed:NAME` accepts the name of a view"):
        plan_views(scene, "orbit:c3/1")


def test_views_of_a_scene_keep_their_timestamps(scene):
    assert [view.time for view in plan_views(scene, "views", frames=4)] == [0, 1, 0, 1]
    assert {view.time for view in plan_views(scene, "views", times=0.5)} == {0.5}


def test_static_model_has_no_times(scene):
    still = replace(scene, views=tuple(replace(view, time=None) for view in scene.views))
    assert {view.time for view in plan_views(still, moves=False)} == {None}
    with pytest.raises(ConfigError, match="the model does not move; omit the time"):
        plan_views(still, times=0.5, moves=False)


def test_nearest_photo_is_that_of_the_nearest_timestamp(scene):
    view = replace(scene.views[6], name="frame", time=0.9)
    assert nearest_view(view, scene.views, scene.extent).name == "c3/1"
    assert nearest_view(replace(view, time=0.1), scene.views, scene.extent).name == "c3/0"


def test_path_file_keeps_its_times(scene, tmp_path):
    views = plan_views(scene, times="0..0.5")
    write_camera_path(tmp_path / "path.json", views, 30)
    again = camera_path.read(tmp_path / "path.json").views
    assert [view.time for view in again] == pytest.approx([view.time for view in views])
    assert plan_views(scene, str(tmp_path / "path.json"), frames=None)[2].time == pytest.approx(0.25)
    text = (tmp_path / "path.json").read_text().replace('"render_time": 0.5', '"render_time": 5')
    (tmp_path / "path.json").write_text(text)
    assert "camera_path[4]: render_time is 5; expected 0 to 1" in refusal(camera_path.read, tmp_path / "path.json")
