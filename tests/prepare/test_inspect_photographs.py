"""Inspection of a folder of photographs without cameras."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.prepare.gather import gather, list_photographs
from clsplat.prepare.inspect.facts import CaptureFacts, compare_photos, measure_capture
from clsplat.prepare.inspect.findings import Inspection, summarize
from clsplat.scene.colmap import read_cameras
from clsplat.scene.detect import read_scene
from clsplat.scene.images import CameraExposure
from tests.support.commands import clsplat as run_command
from tests.support.orbit_scene import finding_text, photograph


def texts(inspection: Inspection, level: str) -> list[str]:
    return [finding.text for finding in inspection.findings if finding.level == level]


def test_inspected_folder_is_shell_quoted(tmp_path):
    scene = tmp_path / "my ü"
    for name in ("one/a.png", "one/b.png", "two/c.png"):
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        photograph(scene / name)
    command = f"`clsplat run photos --scene '{scene}'`"
    assert Inspection.from_folder(scene).next_step == command


def test_photographs_without_cameras_get_a_verdict(tmp_path, capsys):
    for i in range(10):
        photograph(tmp_path / f"{i}.png")
    command = f"`clsplat run photos --scene {tmp_path}`"
    inspection = Inspection.from_folder(tmp_path)
    assert (inspection.verdict, inspection.findings) == (f"cameras are not known yet; next: {command}", [])
    assert not inspection.is_trainable, "as it is"
    assert summarize(inspection.facts)["sizes"] == "64x48"
    assert run_command("inspect", tmp_path).stdout.endswith(f"cameras are not known yet; next: {command}\n")


def test_few_photographs_get_advice(tmp_path):
    for i in range(3):
        photograph(tmp_path / f"{i}.png")
    inspection = Inspection.from_folder(tmp_path)
    assert finding_text(inspection, "warning").startswith("there are only 3 photos, often too few to find the cameras")
    assert inspection.verdict.startswith("cameras are not known yet, and there are only 3 photos")
    for i in (1, 2):
        (tmp_path / f"{i}.png").unlink()
    assert "has 1 photo; expected at least 3, preferably 30 or more" in finding_text(
        Inspection.from_folder(tmp_path), "error"
    )


def test_cameras_and_positions_are_read_from_exif(tmp_path):
    """Of a TIFF header with make, model, the focal length, and a position, as phones write it."""
    texts, focal = b"Acme\0\0Acme One\0\0", struct.pack("<6I", 425, 100, 47, 1, 8, 1)
    entries = [(0x010F, 2, 5, 200), (0x0110, 2, 9, 206), (0x8769, 4, 1, 80), (0x8825, 4, 1, 110)]
    block = bytearray(260)
    struct.pack_into("<2sHI", block, 0, b"II", 42, 8)
    for at, rows in ((8, entries), (80, [(0x920A, 5, 1, 220)]), (110, [(2, 5, 3, 228), (4, 5, 3, 228)])):
        struct.pack_into("<H", block, at, len(rows))
        for i, row in enumerate(rows):
            struct.pack_into("<HHII", block, at + 2 + 12 * i, *row)
    block[200 : 200 + len(texts)], block[220 : 220 + len(focal)] = texts, focal
    data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + bytes(block)
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:])
    (tmp_path / "b.jpg").write_bytes(data)
    capture = measure_capture([tmp_path / "a.jpg", tmp_path / "b.jpg"])
    assert capture == CaptureFacts({"8x8": 2}, {"Acme One 4.25 mm": 1, "unknown": 1}, 1)


@pytest.mark.parametrize("level", [0, 5, 120])
def test_blank_photographs_are_refused_as_in_preparation(tmp_path, level):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(10):
        cv2.imwrite(str(photos / f"{i}.png"), np.full((48, 64, 3), level, np.uint8))
    inspection = Inspection.from_folder(photos)
    assert inspection.next_step is None
    assert inspection.verdict.startswith("cannot train: all photos are blank (0.png, 1.png")
    with pytest.raises(DataError, match="all photos are blank"):
        gather(photos, tmp_path / "linked", list_photographs(photos))
    photograph(photos / "9.png")
    assert "9 photos are black or a single color" in Inspection.from_folder(photos).verdict


def test_inspection_reports_files_that_preparation_skips(tmp_path, caplog):
    for name in ("a.png", "b.png", "c.png"):
        photograph(tmp_path / name)
    for name in ("d.heic", "e.dng", "f.cr2"):
        (tmp_path / name).write_bytes(b"raw")
    (tmp_path / "g.jpg").write_text("text")
    inspection = Inspection.from_folder(tmp_path)
    assert not caplog.records, "findings have it"
    list_photographs(tmp_path)
    warned = [record.getMessage().removeprefix(f"{tmp_path}: ") for record in caplog.records]
    assert len(warned) == 3
    damaged = "1 of 4 photos cannot be read: g.jpg (not an image, or a damaged one); export them again"
    assert texts(inspection, "warning")[1:] == [*warned, damaged]


@pytest.mark.parametrize("names", [("a.heic",), ("a.png", "b.png"), ("a.png", "b.png", "c.gif")])
def test_too_few_photographs_are_refused_as_in_preparation(tmp_path, names):
    for name in names:
        photograph(tmp_path / name) if name.endswith("png") else (tmp_path / name).write_bytes(b"raw")
    inspection = Inspection.from_folder(tmp_path)
    with pytest.raises(DataError) as refused:
        list_photographs(tmp_path)
    assert finding_text(inspection, "error").endswith(str(refused.value).removeprefix(str(tmp_path)))
    assert not texts(inspection, "warning"), "the error says what to convert"


def test_two_valid_photographs_are_too_few(tmp_path):
    for name in ("a.png", "b.png"):
        photograph(tmp_path / name)
    (tmp_path / "c.jpg").write_text("text")
    inspection = Inspection.from_folder(tmp_path)
    assert finding_text(inspection, "error").endswith("only 2 of 3 photos can be read; export them again")
    assert finding_text(inspection, "warning").startswith("1 of 3 photos cannot be read: c.jpg")


def write_photographs(folder: Path, factors: list[float]) -> dict[str, Path]:
    """Photographs of one textured thing, each with its brightness by that of the first."""
    rng, files = np.random.default_rng(1), {}
    for i, factor in enumerate(factors):
        files[f"{i}.png"] = folder / f"{i}.png"
        cv2.imwrite(str(folder / f"{i}.png"), (rng.integers(80, 240, (48, 64)) * factor).astype(np.uint8))
    return files


def test_dark_photograph_is_reported_only_if_blurred(tmp_path):
    files = write_photographs(tmp_path, [1, 0.3, 1, 0.3, 1, 0.3])
    assert compare_photos(files).blurred == []
    pixels = cv2.imread(str(files["3.png"]))
    cv2.imwrite(str(files["3.png"]), cv2.GaussianBlur(pixels, (0, 0), 1))
    assert compare_photos(files).blurred == ["3.png"]


def test_close_up_on_black_is_not_blurred(tmp_path):
    files = write_photographs(tmp_path, [1] * 9)
    for name in [*files][:6]:
        pixels = cv2.imread(str(files[name]))
        pixels[:, 10:] = 0
        cv2.imwrite(str(files[name]), pixels)
    assert compare_photos(files).blurred == []


def test_brightness_step_is_a_hint_without_exif_exposure(tmp_path):
    files = write_photographs(tmp_path, [1, 0.9, 0.4, 0.6, 0.7, 1])
    ((a, b, ratio),) = compare_photos(files).steps
    assert (a, b, ratio) == ("1.png", "2.png", pytest.approx(0.4 / 0.9, abs=0.02))
    (note,) = texts(Inspection.from_folder(tmp_path), "note")
    assert "1 photo is more than twice or less than half as bright as the one before (1.png to 2.png: 0.45" in note
    told = CameraExposure(0.01, 2.0, 100.0)
    result = compare_photos(files, dict.fromkeys(files, told) | {"2.png": replace(told, seconds=0.001)})
    assert not result.steps
    assert [(a, b) for a, b, _ in result.jumps] == [("1.png", "2.png"), ("2.png", "3.png")]
    assert [(a, b) for a, b, _ in compare_photos(files, {"1.png": told}).steps] == [("1.png", "2.png")], (
        "one alone tells none"
    )


def test_larger_object_on_black_is_no_brightness_step(tmp_path):
    files = write_photographs(tmp_path, [1, 1, 1])
    for name, wide in zip(files, (10, 30, 10), strict=True):
        pixels = cv2.imread(str(files[name]))
        pixels[:, wide:] = 0
        cv2.imwrite(str(files[name]), pixels)
    assert compare_photos(files).steps == []


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("keyframes/corrected_cameras/0.json", '{"fx": 1, "t_00": 1}', "Polycam"),
        ("metadata.json", '{"w": 4, "poses": [[0, 0, 0, 1, 0, 0, 0]]}', "Record3D"),
        ("cameras.xml", '<?xml version="1.0"?>\n<document version="1.5.0">\n  <chunk label="a"/>', "Metashape"),
        ("cameras.csv", "#name,x,y,alt,heading", "RealityScan"),
    ],
)
def test_cameras_of_other_programs_are_reported(tmp_path, name, content, program):
    for image in ("a.png", "b.png", "c.png"):
        photograph(tmp_path / image)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(content)
    inspection = Inspection.from_folder(tmp_path)
    expected = f"the cameras of {program} in {tmp_path / name} are not supported; export them in COLMAP's format"
    assert texts(inspection, "warning")[1].startswith(expected)
    assert inspection.next_step
    with pytest.raises(DataError, match=f"photos without cameras; .*the cameras of {program}"):
        read_scene(tmp_path)


def test_files_that_git_lfs_has_not_fetched(tmp_path):
    for image in ("a.png", "b.png", "c.png"):
        photograph(tmp_path / image)
    (tmp_path / "d.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    warning = texts(Inspection.from_folder(tmp_path), "warning")[1]
    assert warning.endswith("d.png (the file is a Git LFS pointer); fetch the content with `git lfs pull`")
    for name in ("cameras.txt", "cameras.bin"):
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\n")
        with pytest.raises(DataError, match=f"{name}: the file is a Git LFS pointer"):
            read_cameras(tmp_path)
