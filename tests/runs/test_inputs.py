"""Inputs of a run: photographs are checked, and must be the same on resume."""

import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import clsplat
from clsplat.core import progress
from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.loading import load
from clsplat.runs import opening
from clsplat.scene import identity as decoding
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity, decode_all, require_decodable
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import View
from tests.support.colmap_writer import tiny_model
from tests.support.commands import clsplat as command
from tests.support.orbit_scene import orbit, write
from tests.support.runs import FEW, crafted, digest, train

pytestmark = pytest.mark.slow
WORDS = [word for key in FEW for word in ("--set", key)]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of caches of the test's own."""
    monkeypatch.setattr(decoding, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files that were decoded."""
    names: list[str] = []
    real = decoding.decode_image

    def decode(data: bytes, path: Path, upright: bool = False) -> np.ndarray:
        names.append(path.name)
        return real(data, path, upright)

    monkeypatch.setattr(decoding, "decode_image", decode)
    return names


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(tiny_scene, tmp_path / "scene")


def damage(file: Path) -> Path:
    """Change a byte in the middle: name, size, header and end stay as they are."""
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 255
    file.write_bytes(content)
    return file


def views(folder: Path) -> tuple[View, ...]:
    return read_scene(folder).views


# ---- before the first step


def test_damaged_test_view_stops_a_run_before_its_first_step(scene, tmp_path):
    file = damage(read_scene(scene).split("test")[1].image_path)
    done = command("run", "smoke", "--scene", scene, "--out", tmp_path / "run", expect=3)
    assert f"1 of 10 image files cannot be used: {file} (not an image, or a damaged one" in done.stderr
    assert not (tmp_path / "run" / "metrics.jsonl").exists()
    with pytest.raises(DataError, match="1 of 10 image files cannot be used"):
        clsplat.Trainer(scene, "smoke")


def test_one_message_lists_all_damaged_files(scene, tmp_path):
    train_views = read_scene(scene).split("train")
    for view in train_views[1:7]:
        view.image_path.write_bytes(b"nothing")
    with pytest.raises(DataError) as error:
        opening.open_run(load("smoke", [f"scene.path='{scene}'"]), tmp_path / "run", None)
    text = str(error.value)
    assert text.startswith(f"{scene}: 6 of 10 image files cannot be used: {train_views[1].image_path} (not an")
    assert text.count(".png (") == 3
    assert text.endswith("; …")
    assert not (tmp_path / "run").exists()


def test_image_of_another_size_is_found_in_the_same_pass(scene):
    views = read_scene(scene).views
    cv2.imwrite(str(views[3].image_path), np.zeros((30, 40, 3), np.uint8))
    files = decode_all(views)
    assert "the image is 40x30 pixels, its camera 40x40; expected the same size" in files[views[3].image_path].fault
    assert [found.fault for file, found in files.items() if file != views[3].image_path] == [""] * 9


def test_masks_are_decoded_too(tmp_path):
    folder = write(tmp_path / "scene", orbit())
    (folder / "masks").mkdir()
    (folder / "masks" / "03.png").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"1 of 25 image files .*masks/03\.png"):
        require_decodable(folder, decode_all(views(folder)))


def test_truncated_jpeg_is_damaged_even_if_it_decodes(tmp_path, monkeypatch):
    images = [replace(image, name=f"{image.name[:2]}.jpg") for image in orbit().images]
    folder = write(tmp_path / "scene", replace(orbit(), images=images))
    file = folder / "images" / "05.jpg"
    file.write_bytes(file.read_bytes()[:-40])
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: np.full((48, 64, 3), 128, np.uint8))  # as OpenCV 4.8 does
    files = decode_all(views(folder))
    assert [path for path, found in files.items() if found.fault] == [file]
    assert files[file].fault == f"{file}: the end of the file is missing; copy it again"


def test_views_without_images_are_skipped(scene):
    made = clsplat.View.looking_at((4, 0, 1), (0, 0, 0), (0, 0, 1), views(scene)[0].camera)
    assert len(decode_all([*views(scene), made])) == 10


# ---- once


def test_checked_images_are_only_hashed_later(scene, decoded, cache):
    first = decode_all(views(scene))
    assert len(decoded) == 10
    decoded.clear()
    assert decode_all(views(scene)) == first
    assert decoded == []
    file = views(scene)[2].image_path
    cv2.imwrite(str(file), np.zeros((40, 40, 3), np.uint8))
    decode_all(views(scene))
    assert decoded == [file.name]
    moved = shutil.move(scene, scene.with_name("elsewhere"))
    decoded.clear()
    decode_all(views(moved))
    assert decoded == []


def test_new_decoder_version_decodes_again(scene, decoded, monkeypatch):
    decode_all(views(scene))
    monkeypatch.setattr(cv2, "__version__", "99.0")
    decode_all(views(scene))
    assert len(decoded) == 20


def test_damaged_files_are_decoded_each_time(scene, decoded):
    file = damage(views(scene)[1].image_path)
    for _ in range(2):
        decoded.clear()
        assert decode_all(views(scene))[file].fault
        assert file.name in decoded


def test_unwritable_cache_costs_only_time(scene, decoded, cache):
    cache.write_text("a file cannot hold a folder")
    for _ in range(2):
        assert not any(value.fault for value in decode_all(views(scene)).values())
    assert len(decoded) == 20


def test_damaged_cache_is_ignored(scene, decoded, cache):
    decode_all(views(scene))
    (file,) = (cache / "decoded").iterdir()
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"\xff\xfe " + b"".join(lines[:4]) + b"what\n" + lines[4].replace(b" ", b"") + lines[5][:-2])
    decoded.clear()
    assert not any(value.fault for value in decode_all(views(scene)).values())
    assert len(decoded) == 7
    decoded.clear()
    decode_all(views(scene))
    assert len(decoded) <= 1  # the line behind the half one


def test_full_cache_is_cleared(scene, decoded, cache, monkeypatch):
    monkeypatch.setattr(decoding, "MAX_CACHE_BYTES", 500)
    for size in (10, 20, 20):
        decode_all(views(scene))
        assert len(decoded) == size or size == 20
    (file,) = (cache / "decoded").iterdir()
    assert file.stat().st_size < 10 * 80


def test_only_a_few_images_are_in_memory_at_once(scene, monkeypatch):
    held, most, lock = [0], [0], threading.Lock()

    def decode(data: bytes, path: Path, upright: bool = False) -> np.ndarray:
        with lock:
            held[0] += 1
            most[0] = max(most[0], held[0])
        time.sleep(0.01)
        with lock:
            held[0] -= 1
        return np.zeros((40, 40, 3), np.uint8)

    monkeypatch.setattr(decoding, "decode_image", decode)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(decoding, "MAX_THREADS", 3)
    decode_all(views(scene))
    assert 1 <= most[0] <= 3


def test_listeners_receive_the_progress(scene):
    heard: list[tuple[str, int, int]] = []
    with progress.listening(lambda *what, seconds_left: heard.append(what)):
        decode_all(views(scene))
    assert heard == [("photos decoded", i, 10) for i in range(11)]


def test_progress_is_logged_periodically(scene, monkeypatch, caplog):
    caplog.set_level("INFO", "clsplat")
    decode_all(views(scene))
    assert "photos decoded" not in caplog.text
    monkeypatch.setattr(progress, "INTERVAL", 0.0)
    decode_all(views(scene))
    assert "photos decoded: 10 of 10" in caplog.text


# ---- the same inputs


def identity(scene: Scene | Path) -> Identity:
    opened = read_scene(scene) if isinstance(scene, Path) else scene
    return Identity.from_scene(opened, decode_all(opened.views))


def edited(path: Path, change: Callable[[dict], None]) -> None:
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table, indent=3))


def test_moved_or_rewritten_equal_files_are_the_same(scene, tmp_path):
    before = identity(scene)
    elsewhere = shutil.copytree(scene, tmp_path / "elsewhere")
    edited(elsewhere / "transforms_train.json", lambda table: None)
    assert identity(elsewhere).digest == before.digest
    assert Identity.from_data(json.loads(json.dumps(before.data()))) == before
    kinds = [identity(write(tmp_path / kind, tiny_model(), kind)).digest for kind in ("bin", "txt")]
    assert kinds[0] == kinds[1]


def test_order_of_the_test_views_does_not_matter(scene):
    opened = read_scene(scene)
    assert identity(replace(opened, test=opened.test[::-1])).digest == identity(opened).digest
    other = identity(replace(opened, train=opened.train[::-1]))
    assert other.changes(identity(opened)) == ["the order of the training views"]
    assert other.digest != identity(opened).digest


def test_every_input_change_is_named(scene, tmp_path):
    opened, before = read_scene(scene), identity(scene)
    train, test = opened.split("train"), opened.split("test")

    def said(changed: Scene) -> str:
        result = identity(changed)
        assert result.digest != before.digest
        return ", ".join(result.changes(before))

    def with_view(index: int, **change: object) -> Scene:
        return replace(
            opened, views=tuple(replace(v, **change) if i == index else v for i, v in enumerate(opened.views))
        )

    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((40, 40, 3), np.uint8))
    pose = opened.views[1].world_to_camera.copy()
    pose[0, 3] += 1e-9
    assert said(with_view(0, image_path=other)) == f"the photo of 1 view ({opened.views[0].name})"
    assert said(with_view(9, mask_path=other)) == f"the mask of 1 view ({opened.views[9].name})"
    assert said(with_view(1, world_to_camera=pose)) == f"the camera of 1 view ({opened.views[1].name})"
    assert said(with_view(1, camera=replace(train[1].camera, cx=3.0))) == f"the camera of 1 view ({train[1].name})"
    assert said(replace(opened, train=opened.train[:-1])) == f"1 view ({train[-1].name}), removed"
    assert said(replace(opened, train=(*opened.train, opened.test[0]), test=opened.test[1:])) == (
        f"the split of 1 view ({test[0].name})"
    )
    assert said(with_view(0, name="fresh")) == f"1 view ({train[0].name}), removed, 1 view (fresh), added"
    assert opened.points is not None
    assert (
        said(replace(opened, points=PointCloud(opened.points.positions[1:], opened.points.colors[1:]))) == "the points"
    )
    many = replace(opened, views=tuple(replace(view, image_path=other) for view in opened.views))
    names = ", ".join(view.name for view in train[:3])
    assert said(many) == f"the photo of 10 views ({names}, …)"


def test_altered_record_is_damaged(scene):
    data = identity(scene).data()
    data["points"] = "other"
    for text in (data, {}, [], None, {**data, "train": 3}):
        with pytest.raises(ValueError, match="damaged"):
            Identity.from_data(text)


@pytest.mark.parametrize("what", ["photograph", "pose", "points"])
def test_run_does_not_resume_with_other_inputs(scene, tmp_path, what):
    out = tmp_path / "run"
    train(scene, out, *FEW)
    (out / "point_cloud.ply").unlink()  # else there is nothing to do
    file = views(scene)[0].image_path
    kept = {path: path.read_bytes() for path in (file, scene / "transforms_train.json", scene / "points3d.ply")}
    if what == "photograph":
        cv2.imwrite(str(file), np.zeros((40, 40, 3), np.uint8))
    elif what == "pose":
        edited(
            scene / "transforms_train.json", lambda table: table["frames"][0]["transform_matrix"][0].__setitem__(3, 0.1)
        )
    else:
        content = bytearray(kept[scene / "points3d.ply"])
        content[-1] ^= 8
        (scene / "points3d.ply").write_bytes(content)
    before = sorted((path.name, path.read_bytes()) for path in out.iterdir() if path.is_file())
    word = {"photograph": "the photo of 1 view", "pose": "the camera of 1 view", "points": "the points"}[what]
    for more in (["--dry-run"], []):
        done = command("run", "smoke", *WORDS, "--scene", scene, "--out", out, "--resume", *more, expect=2)
        assert f"{scene}: differs from the inputs of the run: {word}" in done.stderr
        assert "restore them, or start over: `clsplat run` with --restart or another --out" in done.stderr
        if more:
            assert sorted((path.name, path.read_bytes()) for path in out.iterdir() if path.is_file()) == before
    for path, content in kept.items():
        path.write_bytes(content)
    command("run", "smoke", *WORDS, "--scene", scene, "--out", out, "--resume")


def test_checkpoint_identifies_inputs_without_the_record(scene, tmp_path, caplog):
    train(scene, tmp_path / "run", *FEW)
    record = tmp_path / "run" / "inputs.json"
    record.write_text("{}")
    train(scene, tmp_path / "run", *FEW, resume=True)
    assert "cannot check" not in caplog.text
    assert record.read_text() != "{}"
    record.write_text("{}")
    cv2.imwrite(str(views(scene)[0].image_path), np.zeros((40, 40, 3), np.uint8))
    with pytest.raises(ConfigError, match=r"differs from the inputs of the run: inputs.json is missing or damaged"):
        train(scene, tmp_path / "run", *FEW, resume=True)
    assert record.read_text() == "{}", "the new inputs do not become those of the start"


def test_run_with_unchecked_inputs_resumes_with_a_warning(scene, tmp_path, caplog):
    train(scene, tmp_path / "run", *FEW)
    (tmp_path / "run" / "inputs.json").unlink()
    newest = sorted((tmp_path / "run" / "checkpoints").iterdir())[-1]
    crafted(newest, lambda notes, arrays: notes.update(inputs=""))
    train(scene, tmp_path / "run", *FEW, resume=True)
    assert "inputs.json: missing or damaged; cannot check that the photos are the same" in caplog.text


# ---- dry runs


def test_dry_run_of_a_resume_prints_the_step(scene, tmp_path):
    out = tmp_path / "run"
    words = ["run", "smoke", *WORDS, "--scene", scene, "--out", out, "--dry-run"]
    assert "nothing to resume; would run in" in command(*words, "--resume").stdout
    assert not out.exists()
    train(scene, out, *FEW)
    assert f"{out}: up to date" in command(*words, "--resume").stdout
    (out / "point_cloud.ply").unlink()
    assert f"would continue from step 12 in {out}" in command(*words, "--resume").stdout
    assert "already has a run" in command(*words, expect=2).stderr
    done = command(*words, "--resume", "--set", "seed=7", expect=2)
    assert "saved with other settings: seed was 0, is 7" in done.stderr
    for path in (out / "checkpoints").iterdir():
        path.write_bytes(b"")
    assert "and so are all other checkpoints" in command(*words, "--resume", expect=7).stderr


def test_dry_run_finds_damaged_photographs(scene, tmp_path):
    damage(views(scene)[1].image_path)
    done = command("run", "smoke", "--scene", scene, "--out", tmp_path / "run", "--dry-run", expect=3)
    assert "1 of 10 image files cannot be used" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("how", ["empty", "too few"])
def test_dry_run_of_photographs_is_refused_like_the_run(scene, tmp_path, monkeypatch, how):
    folder = tmp_path / "photos"
    folder.mkdir()
    if how == "too few":
        shutil.copy(views(scene)[0].image_path, folder)
    monkeypatch.chdir(tmp_path)
    for more in (["--dry-run"], []):
        done = command("run", "photos", "--scene", folder, *more, expect=3)
        assert "; expected at least 3, preferably 30 or more" in done.stderr
        if more:
            assert not (tmp_path / "runs").exists()


def test_resuming_a_moved_scene_gives_the_same_bits(scene, few_steps, tmp_path):
    train(scene, tmp_path / "run", *FEW)
    moved = shutil.move(scene, tmp_path / "elsewhere")
    (tmp_path / "run" / "checkpoints" / "step_000012.npz").unlink()
    train(moved, tmp_path / "run", *FEW, resume=True)
    assert digest(tmp_path / "run") == digest(few_steps)
