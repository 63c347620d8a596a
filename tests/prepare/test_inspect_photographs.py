"""Inspection of a folder of photographs without cameras."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.prepare.gather import list_photographs
from clsplat.prepare.inspect.facts import compare_photos
from clsplat.prepare.inspect.findings import Inspection
from clsplat.scene.images import CameraExposure
from tests.support.orbit_scene import finding_text, photograph


def texts(inspection: Inspection, level: str) -> list[str]:
    return [finding.text for finding in inspection.findings if finding.level == level]


def test_inspected_folder_is_shell_quoted(tmp_path):
    scene = tmp_path / "my ü"
    for name in ("one/a.png", "one/b.png", "two/c.png"):
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        photograph(scene / name)
    assert finding_text(Inspection.from_folder(scene), "error") == (
        f"{scene} contains 3 photographs but no camera poses: `clsplat run photos --scene '{scene}'` finds the cameras"
    )


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
    damaged = "1 of 4 photographs cannot be read: g.jpg (not an image, or a damaged one); export them again"
    assert texts(inspection, "warning") == [*warned, damaged]


@pytest.mark.parametrize("names", [("a.heic",), ("a.png", "b.png"), ("a.png", "b.png", "c.heic")])
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
    assert finding_text(inspection, "error").endswith("only 2 of 3 photographs can be read; export them again")
    assert finding_text(inspection, "warning").startswith("1 of 3 photographs cannot be read: c.jpg")


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
    assert note.startswith("1 photograph is more than twice as bright or dark as the one before (1.png to 2.png: 0.45")
    told = CameraExposure(0.01, 2.0, 100.0)
    found = compare_photos(files, dict.fromkeys(files, told) | {"2.png": replace(told, seconds=0.001)})
    assert not found.steps
    assert [(a, b) for a, b, _ in found.jumps] == [("1.png", "2.png"), ("2.png", "3.png")]
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
