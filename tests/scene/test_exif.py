"""Exposures from EXIF data, and from a file next to images without EXIF data."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.photos.exposure_estimate import exposures_from_exif
from clsplat.prepare.gather import gather
from clsplat.scene.camera import Camera
from clsplat.scene.images import (
    EXPOSURES_FILE,
    CameraExposure,
    make_exposure,
    read_exif_exposure,
    read_exposures,
    write_exposures,
)
from clsplat.scene.view import View, load_exposures

CAMERA = Camera(4, 3, 4, 4, 2, 1.5)
EXPOSURE = CameraExposure(seconds=0.01, aperture=2.0, iso=100.0)


def with_exposure(order: str = "<", seconds=(1, 100), aperture=(2, 1), iso: int = 100, orientation: int = 1) -> bytes:
    """A JPEG of 4 x 3 px."""
    _, encoded = cv2.imencode(".jpg", np.arange(36, dtype=np.uint8).reshape(3, 4, 3))
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    turned = struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0)
    outer = struct.pack(order + "H", 2) + turned + struct.pack(order + "HHII", 0x8769, 4, 1, 38) + bytes(4)
    rows = [struct.pack(order + "HHII", tag, 5, 1, at) for tag, at in ((0x829A, 80), (0x829D, 88))]
    rows.append(struct.pack(order + "HHIHH", 0x8827, 3, 1, iso, 0))
    inner = struct.pack(order + "H", 3) + b"".join(rows) + bytes(4)
    block = head + outer + inner + struct.pack(order + "4I", *seconds, *aperture)
    body = b"Exif\0\0" + block
    data = encoded.tobytes()
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]


@pytest.mark.parametrize("order", ["<", ">"])
def test_exposure_is_read_from_jpeg(tmp_path, order):
    (tmp_path / "a.jpg").write_bytes(with_exposure(order))
    assert read_exif_exposure(tmp_path / "a.jpg") == EXPOSURE
    assert EXPOSURE.value == pytest.approx(np.log2(0.01 * 100 / 4))


@pytest.mark.parametrize("change", [{"seconds": (1, 0)}, {"aperture": (0, 1)}, {"iso": 0}])
def test_nonpositive_values_are_none(tmp_path, change):
    (tmp_path / "a.jpg").write_bytes(with_exposure(**change))
    assert read_exif_exposure(tmp_path / "a.jpg") is None


def test_damaged_exif_gives_an_exposure_or_none(tmp_path):
    data = with_exposure()
    for at in range(2, 130):
        for damaged in (data[:at], data[:at] + b"\xff" + data[at + 1 :], data[:at] + b"\0" + data[at + 1 :]):
            (tmp_path / "a.jpg").write_bytes(damaged)
            result = read_exif_exposure(tmp_path / "a.jpg")
            assert result is None or np.isfinite(result.value)


def test_exposures_file_round_trip(tmp_path):
    write_exposures(tmp_path, {"a.png": EXPOSURE, "b.png": None})
    assert read_exposures(tmp_path) == {"a.png": EXPOSURE}
    write_exposures(tmp_path / "none", {"a.png": None})
    assert not (tmp_path / "none").exists()
    assert read_exposures(tmp_path / "none") == {}


@pytest.mark.parametrize("text", ["[]", '{"a": 1}', '{"a": {"seconds": 1e999, "aperture": 2, "iso": 3}}', "{"])
def test_damaged_file_is_refused_in_one_line(tmp_path, text):
    (tmp_path / EXPOSURES_FILE).write_text(text)
    with pytest.raises(DataError, match=EXPOSURES_FILE) as refused:
        read_exposures(tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("numbers", [(1e9, 2, 100), (0.01, 1e200, 100), (0.01, 2, 1e-300), (0.01, 0, 100), (0.01, 2)])
def test_impossible_exposures_are_ignored(numbers):
    assert make_exposure(*numbers, *[None] * (3 - len(numbers))) is None
    assert make_exposure(0.01, 2, 100) is not None


def test_rotated_image_keeps_its_exposure(tmp_path):
    """Its upright copy, too."""
    for number, orientation in enumerate((1, 6, 1)):
        (tmp_path / f"{number}.jpg").write_bytes(with_exposure(iso=100 * (number + 1), orientation=orientation))
    gather(tmp_path, tmp_path / "images", ["0.jpg", "1.jpg", "2.jpg"])
    assert read_exif_exposure(tmp_path / "images" / "1.jpg").iso == 200
    assert {name: one.iso for name, one in read_exposures(tmp_path / "images").items()} == {
        "0.jpg": 100,
        "1.jpg": 200,
        "2.jpg": 300,
    }


def view(path: Path, name: str) -> View:
    return View(name, CAMERA, np.eye(3, 4), path / name)


def test_exposures_file_takes_precedence_over_exif(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("in/a.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(with_exposure())
    (tmp_path / EXPOSURES_FILE).write_text(json.dumps({"in/a.jpg": {"seconds": 1, "aperture": 1, "iso": 1}}))
    by_hand = View("c", CAMERA, np.eye(3, 4))
    views = [view(tmp_path, "in/a.jpg"), view(tmp_path, "b.jpg"), by_hand]
    assert load_exposures(views) == [CameraExposure(1, 1, 1), EXPOSURE, None]


def test_camera_gains_are_light_ratios_to_the_display_power(tmp_path):
    (tmp_path / "a.jpg").write_bytes(with_exposure(iso=100))
    (tmp_path / "b.jpg").write_bytes(with_exposure(iso=400))
    result = exposures_from_exif([view(tmp_path, "a.jpg"), view(tmp_path, "b.jpg")])
    half = np.log(4) / 2.2 / 2
    assert result.log_gains["b.jpg"] == pytest.approx([half] * 3)
    assert result.log_gains["a.jpg"] == pytest.approx([-half] * 3)
    assert result.spread == pytest.approx(half)
    assert exposures_from_exif([]).log_gains == {}
