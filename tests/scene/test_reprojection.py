"""The reprojection error: measurement, storage, and settings that depend on it."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.loading import apply_adaptation, load
from clsplat.prepare.inspect.findings import POSES, POSES_ERROR, Inspection
from clsplat.prepare.undistort import undistort_scene
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.quality import Measures, measure_scene
from clsplat.scene.reprojection import filter_tracks, reprojection_errors, reprojection_residuals
from clsplat.scene.scene import Tracks
from clsplat.scene.view import View
from clsplat.sweeps.experiment import run_pipeline
from clsplat.training.modules.camera_optimizer import CameraOptimizer
from clsplat.training.modules.exposure import Exposure
from tests.support.camera_rings import STRONG
from tests.support.outdoor_scene import Yard, missing
from tests.support.runs import FEW

VECTOR = np.array([1.2, -0.9])  # px, 1.5 long
OFFSET = np.array([0.1, 0.2, 0.3])

STATE = ("status.json", "log.txt")  # which tell of the refusal


@pytest.mark.parametrize("lens", [None, STRONG])
def test_error_is_the_distance_to_the_projected_point(rng, lens):
    view = View("a.png", STRONG.pinhole, np.column_stack([np.eye(3), OFFSET]), lens=lens)
    points = np.column_stack([*rng.uniform(-0.4, 0.4, (2, 7)), np.full(7, 2.0)])
    seen, camera = points + OFFSET, view.camera
    straight = seen[:, :2] / seen[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    places = lens.project(seen) if lens else straight
    points[3, 2] = -5
    result = reprojection_residuals(view, points, places + VECTOR)
    assert np.isnan(result[3]).all(), "behind the camera"
    np.testing.assert_allclose(np.delete(result, 3, axis=0), np.tile(VECTOR, (6, 1)), atol=1e-9)
    straight[:4] = [[1e7, 1e7], [-1e308, 0], [np.inf, 0], [np.nan, 1]]
    assert np.isnan(reprojection_residuals(view, points, straight)[:4]).all(), "outside the photo"


def test_mean_is_over_points_then_over_views():
    view = View("a", STRONG.pinhole, np.eye(3, 4))
    seen = {"a": np.array([0, 2]), "b": np.array([2])}
    tracks = Tracks(np.zeros((3, 3)), seen, {"a": np.array([[3.0, 4], [1, 0]]), "b": np.array([[0, 3.0]])})
    assert reprojection_errors(tracks, [view, replace(view, name="b")]) == pytest.approx([5, 2])
    assert reprojection_errors(tracks, [replace(view, name="b").resized(2)]) == pytest.approx([1.5]), "at its size"
    assert reprojection_errors(tracks, [replace(view, name="c")]) is None
    assert reprojection_errors(replace(tracks, residuals={}), [view]) is None
    assert reprojection_errors(None, [view]) is None


def test_points_with_large_errors_give_no_depth():
    """At the size of training; what is not known stays, and so do other photographs."""
    view, rows = View("a", STRONG.pinhole, np.eye(3, 4)), np.array([1, 3, 5, 6])
    missed = {"a": np.array([[0.6, 0.8], [0.5, 0], [np.nan, 0], [0, 2.1]]), "b": np.array([[9.0, 9]])}
    tracks = Tracks(np.zeros((7, 3)), {"a": rows, "b": rows[:1], "c": rows}, missed)
    result = filter_tracks(tracks, [view, replace(view, name="c")])
    assert {name: rows.tolist() for name, rows in result.rows.items()} == {"a": [3, 5], "b": [1], "c": [1, 3, 5, 6]}
    np.testing.assert_array_equal(result.residuals["a"], missed["a"][1:3])
    assert filter_tracks(tracks, [view.resized(2)]).rows["a"].tolist() == [1, 3, 5]
    assert filter_tracks(tracks, [view.resized(2), view, view.resized(4)]).rows["a"].tolist() == [3, 5], (
        "in several sizes"
    )


def test_error_is_at_training_size_without_test_views(tmp_path, rng):
    plain = read_scene(Yard(rng).write(tmp_path / "plain"), 6)
    tested = tuple(view.name for view in plain.split("test"))
    again = read_scene(missing(tmp_path / "again", VECTOR, rng, exact=tested), 6)
    assert measure_scene(again).reprojection_error == pytest.approx(1.5, rel=1e-5)
    assert measure_scene(again.downscaled(2)).reprojection_error == pytest.approx(0.75, rel=1e-5)
    assert measure_scene(plain).reprojection_error is None, "places that were computed from cameras tell nothing"


def test_undistorted_scenes_keep_the_error(tmp_path, rng):
    undistort_scene(missing(tmp_path / "scene", VECTOR, rng), tmp_path / "small", 32)
    assert measure_scene(read_scene(tmp_path / "small", 0)).reprojection_error == pytest.approx(0.75, rel=1e-5)


def test_nonnumeric_positions_in_text_are_ignored(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n35 24 7 ? 3 5\n")
    (tmp_path / "points3D.txt").write_text("7 0 0 1 9 9 9 0.5 1 0\n5 1 0 1 9 9 9 0.5 1 1\n")
    write_image(tmp_path / "images" / "a.png", np.zeros((48, 64, 3), np.uint8))
    tracks = read_scene(tmp_path, 0).tracks
    assert tracks is not None
    assert tracks.rows["a.png"].tolist() == [1, 0]
    np.testing.assert_array_equal(tracks.residuals["a.png"], [[np.nan, np.nan], [3, 0]])


@pytest.mark.parametrize(("error", "learned"), [(0.4, False), (0.99, False), (1.0, True), (3.0, True)])
def test_photos_recipe_optimizes_poses_from_one_pixel(error, learned):
    chosen = apply_adaptation(load("photos"), Measures(60, error))
    training = chosen.settings.optimize
    exposure = Exposure(when="auto", **({} if learned else {"min_spread": 0.2}))
    assert training.modules == [*([CameraOptimizer(start=500)] if learned else []), exposure]
    if not learned:
        assert training.model_copy(update={"modules": []}) == load("fast").settings.training
    assert f"cameras fit the points to {error:g} px: " in chosen.decisions[-1].reason
    without = apply_adaptation(load("photos"), Measures(60)).settings.optimize
    assert [module.type for module in without.modules] == ["exposure"]


@pytest.mark.parametrize(("length", "level"), [(0.5, None), (1.5, "note"), (2.5, "warning")])
def test_inspect_recommends_a_setting(tmp_path, rng, length, level):
    inspection = Inspection.from_folder(missing(tmp_path / "scene", length * VECTOR / 1.5, rng))
    assert inspection.facts.points is not None
    assert inspection.facts.points.error_mean == pytest.approx(length, rel=1e-5)
    actual = [one for one in inspection.findings if "reprojection" in one.fault]
    assert [one.level for one in actual] == ([] if level is None else [level])
    assert all('--set "optimize.modules.camera_optimizer={start: 500}"' in one.remedy for one in actual)


def test_inspect_and_the_photos_recipe_agree():
    for error, learned in ((POSES_ERROR - 0.01, None), (POSES_ERROR, {"start": 500})):
        (actual,) = [
            decision
            for decision in apply_adaptation(load("photos"), Measures(9, error)).decisions
            if decision.key in POSES
        ]
        assert actual.value == learned
    assert POSES == "optimize.modules.camera_optimizer={start: 500}"


@pytest.mark.parametrize(
    ("of_step", "reason"),
    [
        ("optimize.modules.random_background={}", "'random_background' cannot be combined with sky: "),
        ("optimize.modules.camera_optimizer={start: 1}", "'camera_optimizer' cannot be combined with sky: "),
    ],
)
def test_optional_sky_is_off_with_conflicting_settings(of_step, reason, tmp_path, rng, caplog):
    folder, (name, value) = missing(tmp_path / "scene", VECTOR, rng), of_step.split("=", 1)
    caplog.set_level("DEBUG", "clsplat")
    pipeline = load("smoke", [f"scene.path='{folder}'", f"{name}={value}", "model.background=auto"])
    describe(pipeline, RunState.read(tmp_path / "run"), None, "new")
    assert f"model.background: off, since {reason}" in caplog.text


def test_pipeline_with_poses_and_sky_is_refused():
    for recipe in ("smoke", "photos"):  # which may decide either
        with pytest.raises(ConfigError, match="cannot be learned together with poses"):
            load(recipe, ["optimize.modules.camera_optimizer={start: 1}", "model.background=envmap"])
        with pytest.raises(ConfigError, match="'random_background' cannot be combined with sky"):
            load(recipe, ["optimize.modules.random_background={}", "model.background=envmap"])
    pipeline = load("photos", ["model.background=envmap"])  # which may learn poses
    with pytest.raises(ConfigError, match=r"adapt: photos: .*cannot be learned together with poses.*; overrid"):
        apply_adaptation(pipeline, Measures(60, 1.0))


@pytest.mark.slow
def test_enabling_poses_disables_the_sky(tmp_path, rng):
    """With photographs that choose the steps, and a training on all of them after that."""
    folder = missing(tmp_path / "scene", VECTOR, rng)
    asked = [f"scene.path='{folder}'", *FEW, "scene.validation=auto", "optimize.keep=best", "optimize.refit=true"]
    asked += ["model.background={type: auto, photographs: 0.25}", "adapt={type: photos, keep: [model.background]}"]
    asked += ["optimize.modules.random_background=null"]
    run_pipeline(load("smoke", asked), RunState.read(tmp_path / "run"), None, "new")
    written = load(str(tmp_path / "run" / "pipeline.yaml")).settings
    assert "camera_optimizer" in [module.type for module in written.training.modules]
    background = written.model.background
    assert background.chosen == "off"
    assert background.reason.startswith("'camera_optimizer' cannot be combined with sky: ")
    assert (tmp_path / "run" / "view_poses.json").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        (["optimize.during.0={snapshot: {every: 2, view: nosuch}}"], "the scene has no view 'nosuch'"),
        (["optimize.losses=[l1, {type: inverse_depth, folder: nosuch}]"], "nosuch.*: the depth map of .* is missing"),
        (
            ["optimize.losses=[l1, inverse_depth]", "optimize.modules.camera_optimizer={start: 1}"],
            "cannot be combined with inverse_depth",
        ),
    ],
)
def test_refused_restart_changes_no_file(changes, fault, tmp_path, rng):
    folder, out = missing(tmp_path / "scene", VECTOR, rng), tmp_path / "run"
    asked = [f"scene.path='{folder}'", *FEW]
    run_pipeline(load("smoke", asked), RunState.read(out), None, "new")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name not in STATE}
    for begin in (describe, run_pipeline):
        with pytest.raises((ConfigError, DataError), match=fault):
            begin(load("smoke", [*asked, *changes]), RunState.read(out), None, "restart")
    assert {path: path.read_bytes() for path in before} == before
