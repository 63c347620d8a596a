"""Camera poses: derivatives, their table, and whole runs that optimize them."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.api.commands import evaluate
from clsplat.conformance import reference as ref
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.schedule import at_step
from clsplat.pipeline.loading import load
from clsplat.runs.model_file import write_cameras
from clsplat.scene.detect import read_scene
from clsplat.training import checkpoint
from clsplat.training.modules.base import attach_modules
from clsplat.training.modules.camera_optimizer import (
    DEPTHS,
    CameraOptimizer,
    CameraState,
    PoseChange,
)
from tests.support.oracle import BACKGROUND, general_camera, random_gaussians, to_world
from tests.support.runs import FEW, digest, killed, train

ON = (*FEW, "optimize.modules.camera_optimizer={start: 2}")
STEP = 1e-4  # of five-point differences


def numeric(function) -> np.ndarray:
    """The derivatives of a function of three numbers at zero."""
    values = [[function(k * STEP * axis) for k in (-2, -1, 1, 2)] for axis in np.eye(3)]
    return np.array(values) @ np.array([1, -8, 8, -1]) / (12 * STEP)


@pytest.mark.parametrize("screen", [{"variance": 0.3}, {"variance": 0.1, "compensate": 1.0}], ids=["blur", "mip"])
@pytest.mark.parametrize("outside", [False, True])
def test_pose_derivatives_match_those_of_the_image(screen, outside):
    """In float64, with rays beyond the limits of the linear projection too."""
    rng, camera, degree = np.random.default_rng(3), general_camera(), 3
    gaussians = random_gaussians(rng, camera, degree, count=4)
    if outside:
        gaussians.means[0] = to_world(camera, np.array([1.9, -1.2, 2.0]))
        gaussians.log_scales[0] = np.log(0.9)
        assert np.any(ref.clamped_ray(camera, np.array([1.9, -1.2, 2.0])) != [1.9, -1.2])
    gaussians.filter_variance = np.full(4, 0.01)
    weights = rng.normal(0, 1, (3, camera.height, camera.width))

    def value(shift: np.ndarray, turn: np.ndarray, zoom: float = 0.0) -> float:
        at = ref.move_camera(camera, shift, turn, zoom)
        frame = ref.render(gaussians, at, BACKGROUND, degree, thresholds=ref.SMOOTH_THRESHOLDS, **screen)
        return float(np.sum(weights * frame.image))

    splats = ref.project(gaussians, camera, degree, thresholds=ref.SMOOTH_THRESHOLDS, **screen)
    of_splats = ref.blend_backward(splats, camera.width, camera.height, BACKGROUND, weights, ref.SMOOTH_THRESHOLDS)
    upstream = of_splats.mean2d, of_splats.conic, of_splats.opacity, of_splats.color
    numbers = screen["variance"], screen.get("compensate", 0.0)
    shift, turn, zoom = ref.pose_gradient(gaussians, camera, degree, *numbers, splats, *upstream)
    assert shift == pytest.approx(numeric(lambda change: value(change, np.zeros(3))), rel=1e-6)
    assert turn == pytest.approx(numeric(lambda change: value(np.zeros(3), change)), rel=1e-6)
    assert zoom == pytest.approx(numeric(lambda change: value(np.zeros(3), np.zeros(3), change[0]))[:1], rel=1e-6)


@pytest.mark.parametrize("depth", [0.0, 2.5])
def test_parameter_derivatives_match_a_moved_scene(rng, depth):
    """A loss of points in the axes of the camera; the numbers are far from zero."""
    pose = np.column_stack([Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)])
    points, weights = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    turn, shift = 0.4 * rng.normal(size=3), rng.normal(size=3)

    def value(turn: np.ndarray, shift: np.ndarray) -> float:
        at = PoseChange(turn, shift, depth).apply_to(pose)
        return float((weights * np.sin(points @ at[:, :3].T + at[:, 3])).sum())

    move = PoseChange(turn, shift, depth)
    at = move.apply_to(pose)
    center = -at[:, :3].T @ at[:, 3]
    by_points = (weights * np.cos(points @ at[:, :3].T + at[:, 3])) @ at[:, :3]
    grad_turn, by_shift = move.gradients(at, by_points.sum(axis=0), np.cross(points - center, by_points).sum(axis=0))
    assert grad_turn == pytest.approx(numeric(lambda change: value(turn + change, shift)), rel=1e-7)
    assert by_shift == pytest.approx(numeric(lambda change: value(turn, shift + change)), rel=1e-7)
    at_pivot = at[:, :3] @ (shift - pose[:, :3].T @ pose[:, 3] + depth * pose[2, :3]) + at[:, 3]
    assert at_pivot == pytest.approx([0, 0, depth]), "it turns about that point"
    small, larger = (
        PoseChange(size * turn, shift, 0).gradients(at, np.zeros(3), grad_turn)[0] for size in (1e-5, 1e-3)
    )
    assert small == pytest.approx(larger, rel=2e-3)


def test_rates_start_late_and_follow_the_visits():
    often, seldom = CameraOptimizer().rates(30_500, 50), CameraOptimizer().rates(2500, 50)
    assert [at_step(often[1], step) for step in (0, 500, 30_500)] == pytest.approx([2e-4, 2e-4, 2e-6])
    assert at_step(seldom[1], 500) == pytest.approx(1.16e-3, rel=0.01)
    assert sum(at_step(seldom[1], step) for step in range(500, 2500, 50)) == pytest.approx(0.01, rel=0.1)
    assert at_step(CameraOptimizer().rates(600, 50)[1], 0) == pytest.approx(2e-3), "at most"
    assert at_step(often[0], 500) == pytest.approx(0.3 * 2e-4)
    assert CameraOptimizer(rotation=0.5).rates(30_500, 50)[0] == 0.5
    assert load("smoke").settings.training.modules == []
    assert load("smoke", ["optimize.modules.camera_optimizer={}"]).settings.training.modules == [CameraOptimizer()]


def test_other_cameras_follow_the_trained_ones(tiny_scene):
    scene = read_scene(tiny_scene, 5)
    poses = CameraState(CameraOptimizer(), scene.split("train"), scene.views)
    for table in poses.pose_tables:
        table.begin(poses.scalars, {})
    poses.scalars |= {f"{DEPTHS}/{view.name}": 0.0 for view in poses.views}
    for view, other in zip(scene.views, poses.apply_to(scene).views, strict=True):
        assert other.world_to_camera == pytest.approx(view.world_to_camera, abs=1e-12)
    middle = np.mean([view.position for view in poses.views], axis=0)
    poses.pose_tables[1].begin(poses.scalars, {view.name: 0.1 * (view.position - middle) for view in poses.views})
    for view, other in zip(scene.views, poses.apply_to(scene).views, strict=True):
        assert other.position == pytest.approx(middle + 1.1 * (view.position - middle))
        assert other.world_to_camera[:, :3] == pytest.approx(view.world_to_camera[:, :3])


@pytest.fixture(scope="module")
def with_poses(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps in which poses are learned; nothing is changed in it."""
    out = tmp_path_factory.mktemp("runs") / "poses"
    train(tiny_scene, out, *ON)
    return out


@pytest.mark.slow
def test_resumed_run_has_the_same_bits(with_poses, tiny_scene, tmp_path):
    out = killed(with_poses, tmp_path / "run")
    run = train(tiny_scene, out, *ON, resume=True)
    assert digest(out) == digest(with_poses)
    scalars = run.modules["camera_optimizer"].scalars
    assert scalars == checkpoint.load(checkpoint.list_files(with_poses)[-1])[0].modules["camera_optimizer"]
    assert sum(value for name, value in scalars.items() if name.endswith("x/updates")) == 2 * (12 - 2)
    assert attach_modules([], run, 24)[0].pose_change(run.scene.split("train")[0].name).translation.any(), "they stay"
    for table in run.modules["camera_optimizer"].pose_tables:
        rows = np.array([table.row(scalars, view) for view in table.views])
        assert rows.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
        assert np.abs(rows).max() > 1e-4


@pytest.mark.slow
def test_poses_change_no_bits_before_their_start(tiny_scene, tmp_path, few_steps, with_poses):
    train(tiny_scene, tmp_path / "late", *FEW, "optimize.modules.camera_optimizer={start: 12}")
    assert digest(tmp_path / "late") == digest(few_steps) != digest(with_poses)


@pytest.mark.slow
def test_metrics_and_tables_use_the_optimized_cameras(with_poses, tiny_scene, tmp_path):
    measured = json.loads((with_poses / "metrics.json").read_text())["test"]["1"]
    assert evaluate(with_poses)["test"]["1"]["psnr"] == pytest.approx(measured["psnr"], abs=1e-6)
    assert "view_poses.json" in json.loads((with_poses / "checksums.json").read_text())
    rows = json.loads((with_poses / "view_poses.json").read_text())["photographs"]
    assert sorted(row["learned"] for row in rows.values()) == [False] * 2 + [True] * 8
    scene = read_scene(tiny_scene, 5)
    moved_views = CameraOptimizer.apply_side_files(with_poses / "point_cloud.ply", scene).views
    assert any((a.world_to_camera != b.world_to_camera).any() for a, b in zip(scene.views, moved_views, strict=True))
    write_cameras(with_poses, tmp_path / "cameras", "nerfstudio", "copy")
    written = [view.world_to_camera for view in read_scene(tmp_path / "cameras", 5).views]
    for view in moved_views:
        assert min(np.abs(pose - view.world_to_camera).max() for pose in written) < 1e-9
    for damage in ("[]", json.dumps({"photographs": {scene.views[0].name: {"world_to_camera": [1, 2]}}})):
        (tmp_path / "view_poses.json").write_text(damage)
        with pytest.raises(DataError, match=r"view_poses.json: .*(expected a mapping|has no valid pose of 3 rows)"):
            CameraOptimizer.apply_side_files(tmp_path / "point_cloud.ply", scene)


@pytest.mark.slow
def test_sky_is_refused(tiny_scene, tmp_path):
    with pytest.raises(ConfigError, match=r"'camera_optimizer' cannot be combined with sky"):
        train(tiny_scene, tmp_path / "run", *ON, "model.background=envmap")
