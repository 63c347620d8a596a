"""Photographs: reading at a camera's size, compositing, writing."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsplat.core.errors import OutputError
from clsplat.scene.camera import Camera
from clsplat.scene.images import read_image, read_image_size, write_image
from clsplat.scene.lookup import require_files
from clsplat.scene.view import View, load_image
from tests.support.data_sets import data_set
from tests.support.refusals import refusal

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
rng = np.random.default_rng(5)


def make_view(path: Path, width: int, height: int) -> View:
    return View("v", Camera(width, height, 50, 50, width / 2, height / 2), np.eye(3, 4), path)


def stored(path: Path, pixels: np.ndarray) -> Path:
    """Write RGB(A) or gray pixels with OpenCV."""
    order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(pixels.shape[2] if pixels.ndim == 3 else 1)
    assert cv2.imwrite(str(path), pixels if order is None else np.ascontiguousarray(pixels[:, :, order]))
    return path


def random(*shape: int, dtype=np.uint8) -> np.ndarray:
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


# ---- reading


def test_rgb_is_returned_as_stored(tmp_path: Path) -> None:
    pixels = random(48, 64, 3)
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 64, 48), WHITE)
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous


def test_name_with_unicode_and_spaces(tmp_path: Path) -> None:
    pixels = random(4, 6, 3)
    path = tmp_path / "fôx 日本.png"
    stored(tmp_path / "a.png", pixels).rename(path)
    np.testing.assert_array_equal(load_image(make_view(path, 6, 4)), pixels)
    assert read_image_size(path) == (6, 4)


def test_gray_becomes_rgb(tmp_path: Path) -> None:
    pixels = random(4, 6)
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 6, 4))
    np.testing.assert_array_equal(image, np.repeat(pixels[:, :, None], 3, axis=2))


def test_sixteen_bits_become_eight(tmp_path: Path) -> None:
    pixels = random(4, 6, 3, dtype=np.uint16)
    pixels[0, 0] = (0, 65535, 257 * 77)
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 6, 4))
    np.testing.assert_array_equal(image, np.rint(pixels / 257))
    assert image[0, 0].tolist() == [0, 255, 77]


@pytest.mark.parametrize("background", [BLACK, WHITE, (0.25, 0.5, 1.0)])
def test_alpha_is_composited_in_double_and_truncated(tmp_path: Path, background) -> None:
    colors, alphas = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    pixels = np.stack([colors, colors[:, ::-1], 255 - alphas, alphas], axis=2)
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 256, 256), background)
    # Transcribed from the reference (3DGS, scene/dataset_readers.py, readCamerasFromTransforms).
    norm = pixels / 255.0
    arr = norm[:, :, :3] * norm[:, :, 3:4] + np.array(background) * (1 - norm[:, :, 3:4])
    np.testing.assert_array_equal(image, (arr * 255.0).astype(np.uint8))
    assert (image[255] == pixels[255, :, :3]).all()  # where it is opaque, nothing is lost


def test_sixteen_bit_alpha_is_blended(tmp_path: Path) -> None:
    pixels = np.full((2, 2, 4), 65535, np.uint16)
    pixels[:, :, 3] = 32768
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 2, 2))
    assert (image == 127).all()  # 127.502 truncated


def test_exif_rotation_is_ignored(tmp_path: Path) -> None:
    """COLMAP's poses are of the pixels as stored."""
    jpeg = cv2.imencode(".jpg", random(8, 16, 3))[1].tobytes()
    orientation = struct.pack("<2sHIHHHII", b"II", 42, 8, 1, 0x0112, 3, 1, 6) + b"\0\0\0\0"
    exif = b"Exif\0\0" + orientation
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    assert cv2.imread(str(path)).shape == (16, 8, 3)  # the tag is understood
    assert load_image(make_view(path, 16, 8)).shape == (8, 16, 3)


@pytest.mark.parametrize("order", ["<", ">"])
def test_orientation_of_a_tiff_is_ignored_too(tmp_path: Path, order: str) -> None:
    pixels = random(8, 16, 3)
    entries = [(256, 3, 16), (257, 3, 8), (258, 3, 8), (259, 3, 1), (262, 3, 2), (273, 4, 122), (0x0112, 3, 6)]
    entries += [(277, 3, 3), (279, 4, pixels.size)]
    rows = [
        struct.pack(f"{order}HHI{'HH' if kind == 3 else 'I'}", tag, kind, 1, *((value, 0) if kind == 3 else (value,)))
        for tag, kind, value in sorted(entries)
    ]
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, len(rows))
    (tmp_path / "a.tif").write_bytes(head + b"".join(rows) + bytes(4) + pixels.tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), pixels)
    assert read_image(tmp_path / "a.tif", upright=True).shape == (16, 8, 3)


@pytest.mark.parametrize("content", [None, b"", b"no image", "cut"])
def test_unreadable_image_is_named(tmp_path: Path, content) -> None:
    path = tmp_path / "a.png"
    if content is not None:
        whole = stored(tmp_path / "b.png", random(48, 64, 3)).read_bytes()
        path.write_bytes(whole[: len(whole) // 2] if content == "cut" else content)
    assert "a.png: " in refusal(load_image, make_view(path, 64, 48))


def test_float_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tiff"
    assert cv2.imwrite(str(path), np.zeros((4, 6, 3), np.float32))
    assert "float32" in refusal(load_image, make_view(path, 6, 4))


# ---- resizing


@pytest.mark.parametrize("factor", [2, 4])
def test_downscaling_is_a_box_mean(tmp_path: Path, factor: int) -> None:
    pixels = random(48, 64, 3)
    view = make_view(stored(tmp_path / "a.png", pixels), 64 // factor, 48 // factor)
    mean = pixels.reshape(48 // factor, factor, 64 // factor, factor, 3).mean(axis=(1, 3))
    image = load_image(view)
    assert np.abs(image - mean).max() <= 0.5 + 1e-4  # rounded to nearest
    assert abs((image - mean).mean()) < 0.02


def test_alpha_is_averaged_separately_from_colors(tmp_path: Path) -> None:
    pixels = random(48, 64, 4)
    image = load_image(make_view(stored(tmp_path / "a.png", pixels), 32, 24), WHITE)
    mean = pixels.reshape(24, 2, 32, 2, 4).mean(axis=(1, 3)) / 255
    exact = (mean[:, :, :3] * mean[:, :, 3:] + (1 - mean[:, :, 3:])) * 255
    assert (exact - image).max() < 1
    assert (exact - image).min() > -1e-2


@pytest.mark.parametrize(
    ("size", "camera", "level"),
    [
        *(((90, 90), (30, 30), 1), ((101, 67), (50, 34), 37), ((100, 100), (7, 7), 200), ((90, 90), (30, 30), 255)),
        ((100, 100), (7, 7), 37),
    ],
)
def test_flat_region_keeps_its_value(tmp_path: Path, size, camera, level: int) -> None:
    """Truncation must not turn 199.99999 into 199."""
    flat = np.full((size[1], size[0], 4), level, np.uint8)
    flat[:, :, 3] = 255
    assert (load_image(make_view(stored(tmp_path / "a.png", flat), *camera), WHITE) == level).all()


@given(st.integers(1, 500), st.integers(1, 500), st.floats(1, 40))
@settings(max_examples=100, deadline=None)
def test_every_downscaled_camera_finds_its_image(tmp_path_factory, width: int, height: int, factor: float) -> None:
    path = tmp_path_factory.mktemp("image") / "a.png"
    cv2.imwrite(str(path), np.zeros((height, width), np.uint8))
    camera = Camera(width, height, 50, 50, 0, 0).downscaled(factor)
    assert load_image(View("v", camera, np.eye(3, 4), path)).shape == (camera.height, camera.width, 3)


@pytest.mark.parametrize("size", [(64, 50), (65, 48), (32, 26), (128, 96)])
def test_wrong_size_names_both_sizes(tmp_path: Path, size: tuple[int, int]) -> None:
    path = stored(tmp_path / "a.png", random(48, 64, 3))
    message = refusal(load_image, make_view(path, *size))
    assert "64x48" in message
    assert f"{size[0]}x{size[1]}" in message


def test_real_photograph_is_loaded_as_opencv_does(tmp_path: Path) -> None:
    path = data_set("lund") / "images" / "01.jpg"
    photo = cv2.imread(str(path))[:, :, ::-1]
    np.testing.assert_array_equal(load_image(make_view(path, 480, 360)), photo)
    half = load_image(make_view(path, 240, 180))
    assert abs(half.mean() - photo.mean()) < 0.05


# ---- writing


def test_written_image_is_read_back(tmp_path: Path) -> None:
    pixels = random(5, 7, 3)
    path = tmp_path / "deep" / "er" / "a.png"
    write_image(path, pixels)
    np.testing.assert_array_equal(load_image(make_view(path, 7, 5)), pixels)
    assert [file.name for file in path.parent.iterdir()] == ["a.png"]


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, pixels = tmp_path / "a.png", random(5, 7, 3)
    write_image(path, pixels)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        write_image(path, 255 - pixels)
    np.testing.assert_array_equal(load_image(make_view(path, 7, 5)), pixels)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_write_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_image(tmp_path / "file" / "a.png", random(2, 2, 3))


def test_long_lists_of_missing_files_are_shortened(tmp_path):
    names = [tmp_path / f"{'a' * 5000}{number}.png" for number in range(5)]
    message = refusal(require_files, tmp_path, names)
    assert "5 of 5 image files are missing" in message
    assert len(message) < 1000
