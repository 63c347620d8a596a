"""The time of a view: in [0, 1], kept by copies, and part of the scene's identity."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import PoseError
from clsplat.scene.camera import Camera
from clsplat.scene.identity import Identity
from clsplat.scene.scene import make_scene
from clsplat.scene.view import View
from clsplat.viewer.video.camera_path import resample
from clsplat.viewer.video.plan import resize_view

CAMERA = Camera(40, 30, 50.0, 50.0, 20.0, 15.0)


def moment(time, name="a"):
    return View(name, CAMERA, np.eye(4)[:3], time=time)


def scene_at(path, *times):
    return make_scene(path, [moment(time, f"v{i}") for i, time in enumerate(times)], set(), None)


@pytest.mark.parametrize("time", [0, 1, 0.25, np.float32(0.5), None])
def test_time_from_0_to_1_is_accepted(time):
    assert moment(time).time == time
    assert time is None or type(moment(time).time) is float


@pytest.mark.parametrize("time", [-0.1, 1.5, np.nan, np.inf, "0.5", True])
def test_invalid_time_is_refused_with_name_and_expectation(time):
    with pytest.raises(PoseError, match=r"the time of 'a' is .*; expected a (timestamp|number) from 0"):
        moment(time)


def test_copied_views_keep_their_time(tmp_path):
    view = moment(0.75)
    scene = make_scene(tmp_path, [view], set(), None)
    copies = [view.resized(2), resize_view(view, (20, 20)), *resample([view], 3), scene.with_alpha("mask").views[0]]
    copies += scene.downscaled(2).views
    assert [copy.time for copy in copies] == [0.75] * len(copies)
    assert [between.time for between in resample([moment(0.25), view], 3)] == [0.25, 0.5, 0.75]
    assert [between.time for between in resample([moment(None), view], 3)] == [None] * 3


def test_changed_time_changes_the_scene_identity(tmp_path):
    first, other = (Identity.from_scene(scene_at(tmp_path, 0.0, time), {}) for time in (0.5, 0.75))
    assert first.digest != other.digest
    assert other.changes(first) == ["the time of 1 view (v1)"]
    assert Identity.from_data(other.data()) == other


def test_static_scene_identity_has_no_time(tmp_path):
    still_one = scene_at(tmp_path, None, None)
    assert set(Identity.from_scene(still_one, {}).train["v0"]) == {"photograph", "mask", "camera"}
    moving = replace(still_one, views=tuple(replace(view, time=0.5) for view in still_one.views))
    assert Identity.from_scene(moving, {}).changes(Identity.from_scene(still_one, {})) == [
        "the time of 2 views (v0, v1)"
    ]
