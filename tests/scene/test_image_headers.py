"""Image sizes from headers, compared with the decoder."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsplat.core.errors import DataError
from clsplat.scene.images import Header, read_header, read_image_size
from tests.support.data_sets import data_set
from tests.support.pictures import with_exif


def encoded(suffix: str, *options: int) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (23, 37, 3), np.uint8)
    return cv2.imencode(suffix, pixels, options)[1].tobytes()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp"])
def test_size_is_read_from_the_header_of_each_format(tmp_path, suffix):
    file = tmp_path / f"image{suffix}"
    file.write_bytes(encoded(suffix))
    assert read_header(file) == Header(37, 23)


def test_size_of_a_progressive_jpeg_is_read(tmp_path):
    (tmp_path / "a.jpg").write_bytes(encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1))
    assert read_header(tmp_path / "a.jpg") == Header(37, 23)


@pytest.mark.parametrize("name", ["fox", "kitchen", "lund", "sceaux_photos", "lego_200/test"])
def test_headers_of_real_photographs_have_the_decoded_size(name):
    files = [f for f in sorted(data_set(name).rglob("*")) if f.suffix.lower() in (".jpg", ".png")]
    assert files
    for file in files[:10]:
        header = read_header(file)
        assert (header.width, header.height) == read_image_size(file)
        assert header.is_complete


@pytest.mark.parametrize(
    ("order", "orientation", "expected"), [("<", 6, 6), (">", 6, 6), ("<", 8, 8), (">", 0, 1), ("<", 9, 1)]
)
def test_orientation_is_read_from_exif(tmp_path, order, orientation, expected):
    (tmp_path / "a.jpg").write_bytes(with_exif(encoded(".jpg"), order, orientation))
    assert read_header(tmp_path / "a.jpg") == Header(37, 23, expected)


@pytest.mark.parametrize(
    ("suffix", "behind"), [(".png", b""), (".jpg", bytes(100)), (".png", bytes(200_000)), (".jpg", bytes(200_000))]
)
def test_image_end_is_before_appended_data(tmp_path, suffix, behind):
    whole = encoded(suffix)
    (tmp_path / f"a{suffix}").write_bytes(whole + behind)
    assert read_header(tmp_path / f"a{suffix}").is_complete
    (tmp_path / f"a{suffix}").write_bytes(whole[: len(whole) * 2 // 3])
    assert not read_header(tmp_path / f"a{suffix}").is_complete


def test_files_that_are_not_images(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    for file in (tmp_path / "a.jpg", tmp_path / "none.jpg", tmp_path):
        with pytest.raises(DataError):
            read_header(file)


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_damage_raises_nothing_else(tmp_path_factory, data: st.DataObject) -> None:
    content = bytearray(with_exif(encoded(".jpg"), "<", 6) if data.draw(st.booleans()) else encoded(".png"))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(100, len(content) - 1)))] = data.draw(st.integers(0, 255))
    file: Path = tmp_path_factory.mktemp("image") / "a.jpg"
    file.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        header = read_header(file)
    except DataError:
        return
    assert header.width > 0
    assert header.height > 0
    assert 1 <= header.orientation <= 8
