"""Structure from motion on real photographs, against their known poses, and on difficult ones."""

import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core import progress
from clsplat.core.errors import DataError
from clsplat.core.progress import listening
from clsplat.prepare import features as features_tool
from clsplat.prepare import mapping as mapping_tool
from clsplat.prepare import undistort as undistort_tool
from clsplat.prepare.features import FeatureOptions, find_features
from clsplat.prepare.gather import list_photographs
from clsplat.prepare.mapping import map_cameras, triangulate_pairs
from clsplat.prepare.matching import Pairing, find_similar_pairs, match_features
from clsplat.prepare.undistort import undistort_scene
from clsplat.scene.camera import Camera, Lens
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.detect import read_scene
from clsplat.scene.view import View, load_image, load_mask
from tests.support.colmap_writer import CameraEntry, ColmapModel, ImageEntry, PointEntry
from tests.support.colmap_writer import write_model as write_test_model
from tests.support.data_sets import data_set
from tests.support.pictures import contents, with_orientation
from tests.support.refusals import refusal

ROOT = Path(__file__).parents[2]


def map_photographs(photos: Path, out: Path, **matching: object) -> Path:
    for name in ("features", "matches", "cameras"):
        (out / name).mkdir(parents=True)
    find_features(photos, out / "features", FeatureOptions(480, 2048))
    match_features(out / "features", out / "matches", **matching)
    map_cameras(out / "matches", out / "cameras")
    return out / "cameras"


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fourteen neighboring photographs."""
    pytest.importorskip("pycolmap")
    source = data_set("fox_opencv")
    folder = tmp_path_factory.mktemp("photos")
    for view in sorted(read_scene(source).views, key=lambda view: view.name)[:14]:
        shutil.copy(view.image_path, folder)
    return folder


@pytest.fixture(scope="module")
def mapped(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return map_photographs(photos, tmp_path_factory.mktemp("placed"))


def aligned_errors(actual: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances after the best similarity transform (Umeyama 1991), [N]."""
    a, b = actual - actual.mean(axis=0), truth - truth.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (d * np.diag(sign)).sum() / (a**2).sum()
    return np.linalg.norm(b - scale * a @ (u @ sign @ vt).T, axis=1)


def pose_errors(mapped: Path) -> np.ndarray:
    """Distances of cameras from where they were, by the size of their path."""
    truth = {view.name: view.position for view in read_scene(data_set("fox_opencv")).views}
    views = read_scene(mapped).views
    errors = aligned_errors(np.stack([v.position for v in views]), np.stack([truth[v.name] for v in views]))
    return errors / np.linalg.norm(np.ptp([truth[v.name] for v in views], axis=0))


def test_cameras_match_the_ground_truth(mapped):
    errors = pose_errors(mapped)
    assert len(errors) == 14
    assert np.median(errors) < 0.01
    assert errors.max() < 0.03


def test_cameras_are_reproducible(photos, mapped, tmp_path):
    again = map_photographs(photos, tmp_path)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (again / "sparse" / "0" / name).read_bytes() == (mapped / "sparse" / "0" / name).read_bytes(), name


def test_points_with_two_observations(mapped, tmp_path):
    """The cameras stay, and the points of three photographs; those of pairs come with them."""
    map_cameras(mapped.with_name("matches"), tmp_path, min_track_length=2)
    model, before = read_model(tmp_path / "sparse" / "0"), read_model(mapped / "sparse" / "0")
    assert not list(tmp_path.glob(".*"))
    for number, image in before.images.items():
        assert np.array_equal(model.images[number].cam_from_world().matrix(), image.cam_from_world().matrix())
    views = np.array([point.track.length() for point in model.points3D.values()])
    errors = np.array([point.error for point in model.points3D.values()])
    known = sum(point.track.length() > 2 for point in before.points3D.values())
    assert views.min() == 2
    assert abs((views > 2).sum() - known) < 0.02 * known
    assert (views == 2).sum() > 0.5 * known
    assert errors[views == 2].max() <= 1.0
    once, again = (
        triangulate_pairs(read_model(mapped / "sparse" / "0"), mapped.with_name("matches") / "database.db", tmp_path)
        for _ in range(2)
    )
    points = [{number: point.xyz.tobytes() for number, point in found.points3D.items()} for found in (once, again)]
    assert points[0] == points[1]


def read_model(folder: Path):
    return pytest.importorskip("pycolmap").Reconstruction(str(folder))


@pytest.mark.parametrize("matching", ["sequential", "vocabulary"])
def test_other_matching_modes_place_most_photographs(photos, tmp_path, matching):
    mapped = map_photographs(photos, tmp_path, matching=matching, neighbors=3)
    assert len(read_scene(mapped).views) >= 12


def test_photographs_without_features_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((64, 64), np.linspace(60, 90, 64)).astype(np.uint8))
    with pytest.raises(DataError, match="none has features"):
        map_photographs(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(("count", "attempt"), [(40, "smaller angles and fewer matches"), (16, "denser features")])
def test_second_attempt_registers_more_photographs(photos, tmp_path, monkeypatch, count, attempt):
    """With few features per photograph."""
    monkeypatch.setattr(mapping_tool, "DENSER", FeatureOptions(480, 1500))
    for name in ("features", "matches", "cameras"):
        (tmp_path / name).mkdir()
    find_features(photos, tmp_path / "features", FeatureOptions(480, count))
    match_features(tmp_path / "features", tmp_path / "matches")
    figures = map_cameras(tmp_path / "matches", tmp_path / "cameras")
    assert figures["attempt"] == attempt
    assert figures["registered"] >= 12
    assert pose_errors(tmp_path / "cameras").max() < 0.05
    assert not list((tmp_path / "cameras").glob(".*")), "what attempts have made is removed"


def test_further_attempts_use_the_matching_mode_or_are_off(photos, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(mapping_tool, "DENSER", FeatureOptions(320, 300))
    for name in ("features", "matches", "cameras", "once"):
        (tmp_path / name).mkdir()
    find_features(photos, tmp_path / "features", FeatureOptions(240, 16))
    match_features(tmp_path / "features", tmp_path / "matches", "sequential", 2)
    caplog.set_level("INFO")
    with pytest.raises(DataError, match="could not be registered"):
        map_cameras(tmp_path / "matches", tmp_path / "once", attempts=1)
    assert "retrying" not in caplog.text
    used, more = list[Pairing](), list[int]()
    monkeypatch.setattr(mapping_tool, "match_database", lambda database, pairing: used.append(pairing))
    monkeypatch.setattr(mapping_tool, "match_pairs", lambda database, pairs, threads: more.append(len(pairs)))
    with pytest.raises(DataError):
        map_cameras(tmp_path / "matches", tmp_path / "cameras")
    assert set(used) == {Pairing("sequential", 2)}
    assert len(more) == 4, "with more pairs first, and three times with denser features"
    assert len(set(more)) == 1


# ---- interrupted and gone on with


def rows(database: Path) -> dict[str, list[tuple]]:
    """All tables of a database.  The layout of its file depends on when it was written; its rows do not."""
    with closing(sqlite3.connect(database)) as opened:
        names = [name for (name,) in opened.execute("select name from sqlite_master where type = 'table'")]
        return {name: sorted(opened.execute(f"select * from {name}").fetchall(), key=repr) for name in names}


@pytest.fixture(scope="module")
def five(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five of the photographs, one of them turned by EXIF."""
    folder = tmp_path_factory.mktemp("few")
    for file in sorted(photos.iterdir())[:5]:
        shutil.copy(file, folder)
    file = sorted(folder.iterdir())[2]
    with_orientation(file, cv2.imread(str(file)), 6)
    return folder


def test_features_are_extracted_once_despite_a_kill(five, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    for name in ("whole", "half"):
        (tmp_path / name).mkdir()
    find_features(five, tmp_path / "whole", FeatureOptions(320, 500))
    killed = f"""
import os, signal
from pathlib import Path
from clsplat.prepare import features
find, calls = features.detect_sift, []
def counted(*a):
    calls.append(a)
    return find(*a) if len(calls) < 3 else os.kill(os.getpid(), signal.SIGKILL)
features.detect_sift = counted
features.find_features(Path({str(five)!r}), Path({str(tmp_path / "half")!r}), features.FeatureOptions(320, 500))
"""
    assert subprocess.run([sys.executable, "-c", killed], cwd=ROOT).returncode == -signal.SIGKILL
    detect_sift, sizes = features_tool.detect_sift, []
    monkeypatch.setattr(features_tool, "detect_sift", lambda *a: (sizes.append(a[0].shape), detect_sift(*a))[1])
    find_features(five, tmp_path / "half", FeatureOptions(320, 500))
    assert len(sizes) == 3, "two of five were kept"
    assert rows(tmp_path / "half" / "database.db") == rows(tmp_path / "whole" / "database.db")
    for file in sorted((tmp_path / "whole" / "images").iterdir()):
        assert (tmp_path / "half" / "images" / file.name).read_bytes() == file.read_bytes()


def test_incomplete_database_is_rebuilt(five, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    for name in ("whole", "half"):
        (tmp_path / name).mkdir()
    find_features(five, tmp_path / "whole", FeatureOptions(320, 500))
    first = sorted(path.name for path in five.iterdir())[:2]
    (tmp_path / "half" / "images").mkdir()
    for name in first:
        shutil.copy(five / name, tmp_path / "half" / "images")
    database = str(tmp_path / "half" / "database.db")
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, str(five), image_names=first)
    find_features(five, tmp_path / "half", FeatureOptions(320, 500))
    assert rows(tmp_path / "half" / "database.db") == rows(tmp_path / "whole" / "database.db")


def test_pairs_are_matched_once(photos, mapped, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    source, whole = mapped.parent / "features", mapped.parent / "matches"
    half = tmp_path / "half"
    half.mkdir()
    shutil.copy(source / "database.db", half)
    names = sorted(path.name for path in photos.iterdir())
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("".join(f"{names[0]} {other}\n" for other in names[1:]))
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, options.num_threads, verification.ransac.random_seed = False, 1, 0  # several differ at times
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    pycolmap.match_image_pairs(
        str(half / "database.db"),
        pairing_options=pairing,
        matching_options=options,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    with closing(sqlite3.connect(half / "database.db")) as opened:
        opened.execute("create table counted (pair)")
        opened.execute("create trigger counts after insert on matches begin insert into counted values (1); end")
        opened.commit()
    match_features(source, half)
    actual = rows(half / "database.db")
    assert len(actual.pop("counted")) == 14 * 13 // 2 - 13
    assert actual == rows(whole / "database.db")
    (tmp_path / "cameras").mkdir()
    map_cameras(half, tmp_path / "cameras")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "cameras" / "sparse" / "0" / name).read_bytes() == (
            mapped / "sparse" / "0" / name
        ).read_bytes()


def test_pairs_are_matched_once_despite_a_kill(mapped, tmp_path):
    source, database = mapped.parent / "features", tmp_path / "database.db"
    killed = f"""
import os, signal, threading, time
from pathlib import Path
from clsplat.prepare import matching
def kill():
    while matching.count_matched_pairs(Path({str(database)!r})) < 5:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGKILL)
count_pairs = matching._count_pairs
def start(*given):
    threading.Timer(0.2, kill).start()  # opening the database fails while another reads it
    return count_pairs(*given)
matching._count_pairs = start
matching.match_features(Path({str(source)!r}), Path({str(tmp_path)!r}))
"""
    assert subprocess.run([sys.executable, "-c", killed], cwd=ROOT).returncode == -signal.SIGKILL
    with closing(sqlite3.connect(database)) as opened:
        (kept,) = opened.execute("select count(*) from two_view_geometries").fetchone()
        opened.execute("create table counted (pair)")
        opened.execute("create trigger counts after insert on matches begin insert into counted values (1); end")
        opened.commit()
    assert 5 <= kept < 14 * 13 // 2, "it was killed in the middle"
    match_features(source, tmp_path)
    actual = rows(database)
    assert len(actual.pop("counted")) in (14 * 13 // 2 - kept, 14 * 13 // 2 - kept - 1), (
        "the last one may be half there"
    )
    assert actual == rows(mapped.parent / "matches" / "database.db")


def test_counting_pairs_loses_none(mapped, tmp_path, monkeypatch):
    """A reader in pycolmap's own process would release the locks of its writes."""
    monkeypatch.setattr(progress, "MIN_POLL_INTERVAL", 0.01)
    heard: set[int] = set()
    with listening(lambda what, done, total, seconds_left: heard.add(done)):
        match_features(mapped.parent / "features", tmp_path)
    assert max(heard) == 14 * 13 // 2
    assert len(heard) > 2, "counts between none and all of them"
    assert rows(tmp_path / "database.db") == rows(mapped.parent / "matches" / "database.db")


def test_extraction_reports_its_progress(five, tmp_path):
    heard: list[int] = []

    def hear(what: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        if what == "photos with features":
            heard.append(done)

    with listening(hear):
        find_features(five, tmp_path, FeatureOptions(320, 500))
    assert heard == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("undefined", ["crop", "mask"])
def test_undistortion_resumes(tmp_path, monkeypatch, undefined):
    source, written = shutil.copytree(data_set("fox_opencv"), tmp_path / "source"), []
    write = undistort_tool.write_image

    def counted(path: Path, pixels: np.ndarray) -> None:
        if path.parent.name == "images":
            if len(written) == 7:
                raise KeyboardInterrupt
            written.append(path.name)
        write(path, pixels)

    undistort_scene(source, tmp_path / "whole", 120, undefined)
    monkeypatch.setattr(undistort_tool, "write_image", counted)
    with pytest.raises(KeyboardInterrupt):
        undistort_scene(source, tmp_path / "half", 120, undefined)
    first = list(written)
    written.clear()
    monkeypatch.setattr(undistort_tool, "write_image", lambda path, image: (written.append(path), write(path, image)))
    undistort_scene(source, tmp_path / "half", 120, undefined)
    again = [path.name for path in written if path.parent.name == "images"]
    assert sorted(first + again) == sorted(path.name for path in (tmp_path / "half" / "images").iterdir())
    assert contents(tmp_path / "half") == contents(tmp_path / "whole")
    changed = sorted((source / "images").iterdir())[0]
    shutil.copy(sorted((source / "images").iterdir())[1], changed)
    written.clear()
    undistort_scene(source, tmp_path / "half", 120, undefined)
    assert {path.stem for path in written} == {changed.stem}
    written.clear()
    undistort_scene(source, tmp_path / "half", 90, undefined)
    assert len([path for path in written if path.parent.name == "images"]) == 50


def test_undistorted_images_do_not_mix_with_others(tmp_path):
    source = data_set("fox_opencv")
    name = f"{sorted((source / 'images').iterdir())[3].stem}.png"
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / name), np.zeros((4, 4, 3), np.uint8))
    assert "exists, and was not created from this scene" in refusal(undistort_scene, source, tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["images", name]


# ---- which photographs


def test_photographs_in_subfolders_are_found(tmp_path):
    (tmp_path / "a" / ".hidden").mkdir(parents=True)
    (tmp_path / "runs").mkdir()
    for name in ("b.JPG", "a/ü 1.png", "a/.hidden/x.jpg", ".y.png", "runs/r.png", "K.txt", "c.tif"):
        (tmp_path / name).touch()
    assert list_photographs(tmp_path, tmp_path / "runs") == ["a/ü 1.png", "b.JPG", "c.tif"]
    (tmp_path / "c.tif").unlink()
    assert "has 2 photos; expected at least 3" in refusal(list_photographs, tmp_path, tmp_path / "runs")


def test_damaged_photographs_are_skipped_and_rotated_ones_turned(tmp_path, caplog):
    pytest.importorskip("pycolmap")
    photos = tmp_path / "photos"
    photos.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (32, 48, 3)).astype(np.uint8)
    for i in range(3):
        cv2.imwrite(str(photos / f"{i}.png"), pixels)
    with_orientation(photos / "turned.jpg", pixels, 6)
    (photos / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    (tmp_path / "out").mkdir()
    summary = find_features(photos, tmp_path / "out")
    images = tmp_path / "out" / "images"
    assert summary == {"photographs": 4, "cameras": 2, "damaged": {"broken.jpg": "not an image, or a damaged one"}}
    warned = "1 of 5 photos cannot be read: broken.jpg (not an image, or a damaged one); export them again"
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [warned]
    assert sorted(path.name for path in images.iterdir()) == ["0.png", "1.png", "2.png", "turned.jpg"]
    assert (images / "0.png").is_symlink()
    assert cv2.imread(str(images / "turned.jpg"), cv2.IMREAD_UNCHANGED).shape == (48, 32, 3)


def test_similar_photographs_are_paired(rng):
    """Each shares half of its features with the next one, in a ring."""
    halves = rng.random((6, 300, 128), dtype=np.float32)
    tables = [np.concatenate([halves[i], halves[(i + 1) % 6]]) for i in range(6)]
    assert find_similar_pairs(tables, 2) == [(0, 1), (0, 5), (1, 2), (2, 3), (3, 4), (4, 5)]
    assert find_similar_pairs([*tables[:2], np.empty((0, 128), np.float32)], 1)[0] == (0, 1)
    assert find_similar_pairs([np.empty((0, 128), np.float32)] * 3, 1) == [(0, 1), (0, 2)], "of plain ones, the first"


# ---- the scene written


def test_written_model_reads_back(tmp_path, rng):
    camera = Camera(6, 4, 5.5, 5.25, 3.1, 1.9)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    views = [
        View("é/a.png", camera, np.column_stack([turn, [1.0, 2.0, 3.0]]), tmp_path),
        View("b.png", Camera(4, 6, 5, 5, 2, 3), np.eye(3, 4), tmp_path),
    ]
    write_model(tmp_path / "sparse" / "0", views, None)
    for view in views:
        path = tmp_path / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((view.camera.height, view.camera.width, 3), np.uint8))
    for view, read in zip(sorted(views, key=lambda v: v.name), read_scene(tmp_path).views, strict=True):
        assert (read.name, read.camera) == (view.name, view.camera)
        np.testing.assert_allclose(read.world_to_camera, view.world_to_camera, atol=1e-12)


BENT = [
    Lens(200, 150, "OPENCV", (160.0, 165.0, 97.0, 80.0, -0.25, 0.06, 0.002, -0.001)),
    Lens(200, 150, "OPENCV_FISHEYE", (90.0, 91.0, 101.0, 74.0, 0.02, -0.01, 0.003, 0.0)),
    Lens(200, 150, "SIMPLE_RADIAL", (160.0, 100.0, 75.0, 0.1)),
]


@pytest.mark.parametrize(("lens", "undefined"), list(zip(BENT, cycle(("crop", "mask")), strict=False)))
def test_undistorted_pixels_follow_pinhole_rays(tmp_path, lens, undefined):
    """A pattern that depends on the ray is seen along the pinhole's own rays; what is undefined is masked."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    (tmp_path / "images").mkdir()
    photograph = np.nan_to_num(pattern(*lens.undistort(columns, rows)))
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.rint(photograph).astype(np.uint8))
    entry = CameraEntry(1, lens.model, lens.width, lens.height, lens.params)
    write_test_model(tmp_path / "sparse" / "0", ColmapModel([entry], [ImageEntry("a.png")], [PointEntry((0, 0, 3))]))
    assert undistort_scene(tmp_path, tmp_path / "out", undefined_pixels=undefined) == 1
    (view,) = read_scene(tmp_path / "out", 0).views
    assert view.lens is None
    shown, mask = load_image(view), load_mask(view)
    if undefined == "crop":
        assert mask is None
        mask = np.ones(shown.shape[:2], bool)
    else:
        assert mask is not None
        assert 0.4 < mask.mean() < 1
        assert view.camera.width * view.camera.height > lens.pinhole.width * lens.pinhole.height
    y, x = np.nonzero(mask)
    u, v = (x + 0.5 - view.camera.cx) / view.camera.fx, (y + 0.5 - view.camera.cy) / view.camera.fy
    px, py = lens.distort(u, v)
    inside = (px > 0.5) & (py > 0.5) & (px < lens.width - 0.5) & (py < lens.height - 0.5)  # between pixel centers
    assert inside.mean() > 0.95
    assert np.abs(shown[y, x, 0] - pattern(u, v))[inside].max() < 1


def pattern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Smooth enough for the edge of a fisheye, where a pixel is a long way."""
    return 127 + 100 * np.sin(2 * u) * np.cos(1.5 * v)


def test_undistorted_photographs_are_smaller_and_reused(tmp_path):
    source = data_set("brighton")
    count = undistort_scene(source, tmp_path / "out", long_side=120)
    views = read_scene(tmp_path / "out").views
    assert len(views) == count == len(read_scene(source).views)
    assert {max(view.camera.width, view.camera.height) for view in views} == {120}
    times = {view.image_path: view.image_path.stat().st_mtime_ns for view in views}
    undistort_scene(source, tmp_path / "out", long_side=120)
    assert {path: path.stat().st_mtime_ns for path in times} == times
