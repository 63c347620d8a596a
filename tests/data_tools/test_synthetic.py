"""The demo scene: closed forms of its shapes, exact cameras, and atomic output."""

import errno
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat import cli
from clsplat.core.errors import DataError, OutputError
from clsplat.data_tools import synthetic
from clsplat.data_tools.shapes import Cuboid, Cylinder, Shape, Sphere
from clsplat.data_tools.still_life import SCENE
from clsplat.data_tools.synthetic import STILL_LIFE, SyntheticOptions, write_dataset
from clsplat.scene.points import read_points_ply

Array = NDArray[Any]

TINY = SyntheticOptions(size=24, train=4, test=2)


def plain(points: Array) -> Array:
    return np.full_like(points, 0.5)


def column(*values: float) -> Array:
    return np.array(values)[:, None]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "demo"
    write_dataset(out, TINY, workers=1)
    return out


def frames(dataset: Path, split: str) -> list[tuple[Array, float, Array]]:
    """Camera-to-world, focal length in pixels and RGBA image of each view, from the files."""
    table = json.loads((dataset / f"transforms_{split}.json").read_text())
    focal = TINY.size / 2 / np.tan(table["camera_angle_x"] / 2)
    poses = [np.array(frame["transform_matrix"]) for frame in table["frames"]]
    names = [f"{dataset / frame['file_path']}.png" for frame in table["frames"]]
    images = [np.asarray(cv2.imread(name, cv2.IMREAD_UNCHANGED)) for name in names]
    return [(pose, focal, image) for pose, image in zip(poses, images, strict=True)]


def test_sphere_distance_is_closed_form() -> None:
    ball = Sphere(center=(0, 0, 2), radius=0.5, paint=plain)
    origins = np.array([[0, 0, 0], [0.3, 0, 0], [0.6, 0, 0], [0, 0, 2], [0, 0, 3]]).T
    expected = [1.5, 2 - 0.4, np.inf, 0.5, np.inf]  # center, chord, past it, from inside, behind
    np.testing.assert_allclose(ball.intersect(origins, column(0, 0, 1)), expected, rtol=1e-12)


def test_box_faces_turn_with_it() -> None:
    box = Cuboid(center=(1, 2, 3), half=(0.5, 0.25, 0.1), paint=plain, yaw=30)
    side, top = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0]), np.array([0, 0, 1])
    points = np.stack([[1, 2, 3] + 0.5 * side, [1, 2, 3] + 0.1 * top], axis=1)
    outward = np.stack([side, top], axis=1)
    np.testing.assert_allclose(box.normal(points), outward, atol=1e-12)
    np.testing.assert_allclose(box.intersect(points + 2 * outward, -outward), 2, rtol=1e-12)


def test_cylinder_has_a_side_and_caps() -> None:
    can = Cylinder(center=(0, 0, 1), radius=0.5, half=0.2, paint=plain)
    origins = np.array([[2, 0, 1.1], [0.3, 0.3, 5], [0.4, 0.4, 5]]).T
    directions = np.array([[-1, 0, 0], [0, 0, -1], [0, 0, -1]]).T
    np.testing.assert_allclose(can.intersect(origins, directions), [1.5, 3.8, np.inf], rtol=1e-12)
    hits = np.array([[0.5, 0, 1.1], [0.3, 0.3, 1.2]]).T
    np.testing.assert_allclose(can.normal(hits).T, [[1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_tilted_cylinder_points_along_minus_y() -> None:
    rod = Cylinder(center=(0, 0, 0), radius=0.1, half=1, paint=plain, tilt=90)
    np.testing.assert_allclose(rod.intersect(column(0, -3, 0), column(0, 1, 0)), 2, rtol=1e-12)


def test_normals_point_at_the_camera_and_have_length_one(dataset: Path) -> None:
    pose, _, _ = frames(dataset, "train")[0]
    y, x = (v.ravel() + 0.5 for v in np.mgrid[:24, :24])
    origin, directions = STILL_LIFE.camera_rays(pose, 24, x, y)
    distance, index = STILL_LIFE.trace(origin, directions)
    hit = np.isfinite(distance)
    normal = STILL_LIFE.by_shape(Shape.normal, index[hit], origin + distance[hit] * directions[:, hit])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, rtol=1e-9)
    assert (normal * directions[:, hit]).sum(axis=0).max() < 0


@pytest.mark.parametrize("split", ["train", "test"])
def test_surface_point_projects_onto_the_pixel_that_sees_it(dataset: Path, split: str) -> None:
    point = np.array([-0.12, 0.14, 0.72])  # the top of the globe: nothing is higher, so every camera sees it
    for pose, focal, image in frames(dataset, split):
        right, up, backward = np.linalg.inv(pose)[:3] @ [*point, 1]
        x, y = 12 + focal * right / -backward, 12 - focal * up / -backward
        assert backward < 0
        assert image[int(y), int(x), 3] > 0
        ray = pose[:3, :3] @ [(x - 12) / focal, (12 - y) / focal, -1]
        distance, _ = STILL_LIFE.trace(pose[:3, 3:], column(*ray / np.linalg.norm(ray)))
        assert distance[0] == pytest.approx(np.linalg.norm(point - pose[:3, 3]), abs=1e-9)


def test_alpha_is_the_silhouette(dataset: Path) -> None:
    for pose, focal, image in frames(dataset, "test"):
        y, x = np.mgrid[:24, :24] + 0.5
        rays = pose[:3, :3] @ np.stack([(x - 12) / focal, (12 - y) / focal, -np.ones_like(x)]).reshape(3, -1)
        seen = np.isfinite(STILL_LIFE.trace(pose[:3, 3:], rays / np.linalg.norm(rays, axis=0))[0]).reshape(24, 24)
        alpha = image[..., 3]
        assert seen[alpha == 255].all()
        assert not seen[alpha == 0].any()
        assert alpha[12, 12] == 255
        assert (alpha[[0, 0, -1, -1], [0, -1, 0, -1]] == 0).all()
        assert (image[alpha == 0] == 0).all()


def test_test_cameras_are_between_training_cameras() -> None:
    for options in (TINY, SyntheticOptions()):
        train, test = (np.array(poses)[:, :3, 2] for poses in options.poses().values())
        assert np.degrees(np.arccos((test @ train.T).max())) > 4
        assert np.degrees(np.arcsin(test[:, 2])).min() > 10


def distance_to_surface(shape: Shape, points: Array) -> Array:
    """Signed distance of points to a shape, by the textbook formulas; [R]."""
    p = np.abs(shape.local(points))
    match shape:
        case Sphere():
            return np.asarray(np.linalg.norm(p, axis=0) - shape.radius)
        case Cylinder():
            q = np.stack([np.hypot(p[0], p[1]) - shape.radius, p[2] - shape.half])
        case Cuboid():
            q = p - np.array(shape.half)[:, None]
    return np.asarray(np.linalg.norm(np.maximum(q, 0), axis=0) + np.minimum(q.max(axis=0), 0))


def test_points_lie_on_the_surfaces(dataset: Path) -> None:
    points = read_points_ply(dataset / "points3d.ply")
    assert 5000 <= len(points) <= 10000
    gap = np.min([np.abs(distance_to_surface(shape, points.positions.T)) for shape in SCENE], axis=0)
    assert gap.max() < 5 * synthetic.POINT_NOISE  # the largest of 8000 normal deviates is near 4
    assert 0.8 < np.sqrt((gap**2).mean()) / synthetic.POINT_NOISE < 1.1
    assert np.ptp(points.colors, axis=0).min() > 0.5


def test_same_arguments_same_bytes(dataset: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "again", TINY, workers=2)
    files = sorted(p.relative_to(dataset) for p in dataset.rglob("*") if p.is_file())
    assert len(files) == TINY.train + TINY.test + 4
    assert files == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in files:
        assert (dataset / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_finished_data_set_is_not_rebuilt(dataset: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in dataset.rglob("*")}
    assert "already complete" in write_dataset(dataset, TINY)
    assert before == {p: p.stat().st_mtime_ns for p in dataset.rglob("*")}
    with pytest.raises(DataError, match="contains another dataset"):
        write_dataset(dataset, SyntheticOptions(size=24, train=4, test=2, seed=1))


def test_foreign_folders_are_refused_and_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note.txt").write_text("keep")
    monkeypatch.setattr(sys, "argv", ["clsplat", "data", "synthetic", str(tmp_path / "mine")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 3
    assert capsys.readouterr().err.startswith("error: ")
    assert [p.name for p in tmp_path.rglob("*")] == ["mine", "note.txt"]


def test_failure_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(synthetic, "write_points_ply", full)
    with pytest.raises(OutputError, match=r"out: cannot be written \(No space left on device\); check the folder"):
        write_dataset(tmp_path / "out", SyntheticOptions(size=8, train=1, test=1), workers=1)
    assert not list(tmp_path.iterdir())


def test_killed_call_leaves_no_workers_and_no_folder(tmp_path: Path) -> None:
    """Its workers end with it, and the next call removes what it wrote."""
    out = tmp_path / "s"
    words = ["data", "synthetic", str(out), "--train", "40", "--size", "200"]
    with subprocess.Popen([sys.executable, "-P", "-m", "clsplat", *words], stdout=subprocess.PIPE) as process:
        while not list(tmp_path.glob(".s.*.partial/train/*.png")):
            assert process.poll() is None
            time.sleep(0.02)
        process.kill()
        assert process.stdout is not None
        process.stdout.read()  # until its workers, which share its output, have ended
    assert len(list(tmp_path.iterdir())) == 1
    write_dataset(out, TINY, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
