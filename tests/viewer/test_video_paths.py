"""Camera paths: shape, up direction, and refusals."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.scene.camera import Camera
from clsplat.scene.scene import make_scene
from clsplat.scene.view import View
from clsplat.viewer.video.paths import (
    PATHS,
    Rig,
    check_fps,
    check_frames,
    check_size,
    even_size,
    fit_inside,
    nearest_view,
    same_area,
    tour_order,
)
from clsplat.viewer.video.plan import VideoRequest, plan_video
from tests.support.camera_rings import CAMERA, SIZE, UP, rig_of, ring
from tests.support.data_sets import data_set

AHEAD = np.array([0.0, 5.0, 0.0])
BAD_SIZES = ["641x480", "640", "10x9", "10000x10", "-2x4", (640, 480.0), (4,)]


def positions(views):
    return np.stack([view.position for view in views])


def azimuths(views):
    """The angles of views about the z axis."""
    place = positions(views)
    return np.arctan2(place[:, 1], place[:, 0])


def test_focus_and_up_axis_follow_the_cameras(rng):
    rig = rig_of(ring(np.linspace(0, 2 * np.pi, 12, endpoint=False), target=(0.2, -0.1, 0.3)), rng)
    np.testing.assert_allclose(rig.focus, (0.2, -0.1, 0.3), atol=0.01)
    assert rig.up @ UP > 0.99


@pytest.mark.parametrize("name", ["ellipse", "orbit"])
def test_orbit_circles_a_camera_ring_once_at_its_distance(name, rng):
    result = PATHS[name](rig_of(ring(np.linspace(0, 2 * np.pi, 24, endpoint=False)), rng), 36, SIZE)
    place = positions(result)
    np.testing.assert_allclose(np.hypot(place[:, 0], place[:, 1]), 3, rtol=0.05)
    np.testing.assert_allclose(place[:, 2], 1, atol=0.05)
    steps = np.diff(np.unwrap(azimuths(result)))
    assert (np.sign(steps) == np.sign(steps[0])).all()
    assert abs(steps.sum()) == pytest.approx(2 * np.pi * 35 / 36, rel=0.02)
    for view in result:
        assert (view.camera.width, view.camera.height) == SIZE
        assert view.world_to_camera[1, :3] @ UP < -0.9, "up is up in the image"
        x, y, z = view.world_to_camera @ (0, 0, 0, 1)
        assert z > 2
        np.testing.assert_allclose((x, y), 0, atol=0.05)


def test_ellipse_matches_the_extent_of_the_cameras(rng):
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    places = [(4 * np.cos(a), 2 * np.sin(a), 1) for a in angles]
    views = [View.looking_at(p, (0, 0, 0), UP, CAMERA, f"{i:03d}") for i, p in enumerate(places)]
    place = positions(PATHS["ellipse"](rig_of(views, rng), 40, SIZE))
    assert 3.5 < np.abs(place[:, 0]).max() < 4.05
    assert 1.7 < np.abs(place[:, 1]).max() < 2.05


def test_ellipse_of_one_sided_cameras_swings_on_their_side(rng):
    views = ring(np.linspace(-0.8, 0.8, 15))
    result = PATHS["ellipse"](rig_of(views, rng), 60, SIZE)
    assert np.abs(azimuths(result)).max() < 0.9
    assert np.ptp(azimuths(result)) > 0.8
    moves = np.linalg.norm(np.diff(positions([*result, result[0]]), axis=0), axis=1)
    assert moves.max() < 0.5, "the last frame leads to the first"


def test_orbit_reports_unseen_directions(rng, caplog):
    with caplog.at_level(logging.WARNING, "clsplat"):
        PATHS["orbit"](rig_of(ring(np.linspace(-0.8, 0.8, 15)), rng), 4, SIZE)
    assert "degrees of the orbit; the path" in caplog.text


def test_outward_facing_cameras_have_no_orbit(rng):
    views = [
        View.looking_at(view.position, 3 * view.position * (1, 1, 0.2), UP, CAMERA, view.name)
        for view in ring(np.linspace(0, 2 * np.pi, 12, endpoint=False), radius=0.5)
    ]
    with pytest.raises(DataError, match="use the path `through`"):
        PATHS["ellipse"](rig_of(views), 4, SIZE)
    assert len(PATHS["through"](rig_of(views, rng), 7, SIZE)) == 7


def facing(rng, count=20):
    """Views on a plane that look along y."""
    places = np.column_stack([rng.uniform(-0.5, 0.5, count), np.zeros(count), rng.uniform(-0.3, 0.3, count)])
    return [View.looking_at(p, p + AHEAD, UP, CAMERA, f"{i:03d}") for i, p in enumerate(places)]


def test_spiral_sways_no_farther_than_the_cameras(rng):
    views = facing(rng)
    rig = Rig.from_views(views, rng.normal(size=(500, 3)) * 0.3 + (0, 5, 0))
    result = PATHS["spiral"](rig, 50, SIZE)
    assert (np.abs(positions(result)).max(axis=0) <= np.abs(positions(views)).max(axis=0) + 0.05).all()
    assert np.ptp(positions(result)[:, 0]) > 0.3
    assert all(view.world_to_camera[2, 1] > 0.95 for view in result)
    assert 4 < rig.depths[0] < rig.depths[1] < 6


def test_nearly_parallel_axes_meet_within_the_visible_points(rng):
    """As from a drone that looks straight down: the axes alone would meet far below the ground."""
    places = np.column_stack([rng.uniform(-2, 2, (30, 2)), np.full(30, 5.0)])
    slopes = np.column_stack([0.02 * -places[:, :2], np.full(30, -1.0)])
    views = [
        View.looking_at(p, p + s, (0, 1, 0), CAMERA, f"{i:03d}")
        for i, (p, s) in enumerate(zip(places, slopes, strict=True))
    ]
    ground = np.column_stack([rng.uniform(-4, 4, (800, 2)), rng.uniform(-0.2, 0.2, 800)])
    rig = Rig.from_views(views, ground)
    np.testing.assert_allclose(rig.focus, (0, 0, 0), atol=0.8)
    for view in PATHS["ellipse"](rig, 40, SIZE):
        assert view.position[2] > 2, "above the ground"
        assert view.world_to_camera[2, 2] < -0.7, "looking down"


def test_ring_has_no_front_for_a_spiral(rng):
    with pytest.raises(DataError, match="use ellipse or through"):
        PATHS["spiral"](rig_of(ring(np.linspace(0, 2 * np.pi, 12, endpoint=False)), rng), 4, SIZE)


def test_walk_connects_neighbors_regardless_of_names(rng):
    views = ring(np.linspace(0, 4, 25))
    shuffled = [replace(views[i], name=f"{k:03d}") for k, i in enumerate(rng.permutation(25))]
    way = tour_order(rig_of(shuffled, rng))
    steps = np.linalg.norm(np.diff(positions(shuffled)[way], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.5, rel=0.1)
    assert steps.sum() < 1.7 * 12
    by_name = tour_order(rig_of(views, rng))
    assert by_name.tolist() == list(range(25))


def test_walk_passes_near_the_views_and_looks_as_they_do(rng):
    views = ring(np.linspace(0, 2.5, 20))
    result = PATHS["through"](rig_of(views, rng), 100, SIZE)
    place = positions(result)
    gaps = np.linalg.norm(positions(views)[:, None] - place[None], axis=2).min(axis=1)
    assert gaps.max() < 0.15
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).max() < 0.3, "no leaps"
    for view in result:
        closest = nearest_view(view, views, 1.0)
        assert view.world_to_camera[2, :3] @ closest.world_to_camera[2, :3] > 0.97
        assert view.world_to_camera[1, :3] @ closest.world_to_camera[1, :3] > 0.97


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *((name, 1) for name in ("through", "views", "orbit", "ellipse")),
        *(("through", 2), ("ellipse", 2), ("views", 3)),
    ],
)
def test_few_views_are_sufficient(name, count, rng):
    result = PATHS[name](rig_of(ring(np.linspace(0, 1, count)), rng), 5, SIZE)
    assert len(result) == (min(count, 5) if name == "views" else 5)
    assert np.isfinite(positions(result)).all()


def test_views_keep_pose_and_field_of_view():
    (view,) = PATHS["views"](rig_of(ring([0.3])), 3, (300, 120))
    np.testing.assert_array_equal(view.world_to_camera, ring([0.3])[0].world_to_camera)
    camera, scale = view.camera, 120 / 150
    assert (camera.fx, camera.cy) == (180 * scale, 74 * scale)
    assert camera.cx == pytest.approx(101 * scale + (300 - 200 * scale) / 2)


def test_outlier_camera_changes_nothing(rng):
    views = ring(np.linspace(0, 2 * np.pi, 24, endpoint=False))
    stray = View.looking_at((500, 0, 0), (500, 9, 0), UP, CAMERA, "stray")
    with_it, without = (PATHS["ellipse"](rig_of(v), 8, SIZE) for v in ([*views, stray], views))
    np.testing.assert_array_equal(positions(with_it), positions(without))


def test_video_sizes_are_even_and_bounded():
    assert even_size(Camera(225, 401, 9.0, 9.0, 1.0, 1.0)) == (224, 400)
    assert max(even_size(Camera(20001, 10000, 9.0, 9.0, 1.0, 1.0))) <= 8192
    wide = same_area(CAMERA, (400, 300))
    assert (wide.fx, wide.cx, wide.cy) == (360, 200, 150)
    assert fit_inside(CAMERA, (200, 150)) == CAMERA
    assert check_size("640x480") == check_size((640, 480)) == (640, 480)


@pytest.mark.parametrize("size", ["641x480", "640", "10x9", "10000x10", "-2x4", (640, 480.0), (4,)])
def test_bad_sizes_are_refused(size):
    with pytest.raises(ConfigError, match="even numbers"):
        check_size(size)


@pytest.mark.parametrize("frames", [0, 100_001, True, 2.5])
def test_bad_numbers_of_frames_are_refused(frames):
    with pytest.raises(ConfigError, match="whole number from 1"):
        check_frames(frames)


@pytest.mark.parametrize("fps", [0, 241, float("nan"), True])
def test_bad_rates_are_refused(fps):
    with pytest.raises(ConfigError, match="frames per second"):
        check_fps(fps)


def test_unknown_path_and_a_path_without_a_scene_are_refused():
    with pytest.raises(ConfigError, match="path 'elipse': expected one of ellipse, spiral, orbit, through, views"):
        VideoRequest.parse("elipse", None, None, None)
    with pytest.raises(ConfigError, match="needs the cameras of a scene"):
        plan_video(VideoRequest("through"), None, np.zeros((1, 3)))


def test_path_of_a_scene_in_python(rng):
    scene = make_scene(Path("none"), ring(np.linspace(0, 6, 12)), set(), None)
    views = clsplat.camera_path(scene, "orbit", 5, "64x32")
    assert [view.name for view in views] == [f"frame_{i:05d}" for i in range(1, 6)]
    assert clsplat.camera_path(scene)[0].camera.width == 200


def test_ellipse_of_photographs_stays_in_front_of_the_scene():
    scene = clsplat.read_scene(data_set("fox"))
    views = clsplat.camera_path(scene, frames=30)
    middle = scene.points.positions.mean(axis=0)
    mean = np.mean([view.world_to_camera[2, :3] for view in scene.views], axis=0)
    assert all(view.world_to_camera[2, :3] @ mean > 0 for view in views), "not from behind the wall"
    assert all((view.world_to_camera @ [*middle, 1])[2] > 0 for view in views)
