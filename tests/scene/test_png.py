"""PNG metadata changes no pixel and prints nothing; damage is reported with its offset."""

import struct
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.scene.images import read_image, strip_png_metadata

RNG = np.random.default_rng(0)
KINDS = {
    "gray": RNG.integers(0, 256, (9, 7), dtype=np.uint8),
    "color": RNG.integers(0, 256, (9, 7, 3), dtype=np.uint8),
    "alpha": RNG.integers(0, 256, (9, 7, 4), dtype=np.uint8),
    "16 bits": RNG.integers(0, 65536, (9, 7, 3), dtype=np.uint16),
}
METADATA = {
    "a bad color profile": (b"iCCP", b"sRGB\0\0" + zlib.compress(b"x" * 200)),
    "a gamma of 0": (b"gAMA", b"\0\0\0\0"),
    "a gamma": (b"gAMA", struct.pack(">I", 100_000)),
    "sRGB": (b"sRGB", b"\0"),
    "primaries": (b"cHRM", struct.pack(">8I", *[31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000])),
    "a text": (b"tEXt", b"a\0b"),
    "a date that is none": (b"tIME", b"\xff" * 7),
    "a background": (b"bKGD", b"\0" * 6),
}


def chunk(kind: bytes, content: bytes, wrong: int = 0) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content) ^ wrong)


def encoded(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def with_chunk(data: bytes, more: bytes) -> bytes:
    return data[:33] + more + data[33:]  # after IHDR


@pytest.mark.parametrize(
    ("what", "kind", "wrong"),
    [(what, [*KINDS][i % 4], i // 4 ^ i & 1) for i, what in enumerate(METADATA)],
)
def test_metadata_changes_no_pixel_and_prints_nothing(kind, what, wrong, tmp_path, capfd):
    data = encoded(KINDS[kind])
    (tmp_path / "a.png").write_bytes(data)
    plain = read_image(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(with_chunk(data, chunk(*METADATA[what], wrong) * 2))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), plain)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("bits", "level", "row", "expected"),
    [
        (8, 7, b"\0\x07\xc8", [(0, 255), (7, 0), (200, 255)]),
        (2, 1, b"\x18", [(0, 255), (85, 0), (170, 255)]),
        (16, 7, b"\0\x07\x07\0\0\0", [(7, 0), (1792, 65535), (0, 65535)]),
    ],
)
def test_transparent_level_of_a_gray_photograph_is_kept(tmp_path, bits, level, row, expected):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 1, bits, 0, 0, 0, 0))
    pixels = chunk(b"tRNS", struct.pack(">H", level)) + chunk(b"IDAT", zlib.compress(b"\0" + row))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b""))
    assert read_image(tmp_path / "a.png")[0, :, [0, 3]].T.tolist() == [list(pair) for pair in expected]


def test_pixels_do_not_depend_on_truncated_metadata():
    data = with_chunk(encoded(KINDS["color"]), chunk(*METADATA["a gamma"]) + chunk(*METADATA["primaries"]))
    whole, cut = (cv2.imdecode(np.frombuffer(item, np.uint8), -1) for item in (data, strip_png_metadata(data)))
    np.testing.assert_array_equal(whole, cut)
    assert len(strip_png_metadata(data)) < len(data)


def test_palette_transparency_and_orientation_are_kept():
    for kind in (b"tRNS", b"eXIf"):
        data = with_chunk(encoded(KINDS["color"]), chunk(kind, b"\0\1\0\1\0\1"))
        assert strip_png_metadata(data) == data


@pytest.mark.parametrize("name", ["IHDR", "IDAT"])
def test_damaged_chunk_is_named_with_its_offset(name, tmp_path, capfd):
    data = bytearray(encoded(KINDS["color"]))
    at = data.index(name.encode())
    length = struct.unpack_from(">I", data, at - 4)[0]
    data[at + 4 + length] ^= 1  # of the checksum
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(DataError, match=rf"a.png: not .*byte {at - 4}: the checksum of the chunk '{name}' is wrong"):
        read_image(tmp_path / "a.png")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp"])
def test_truncated_image_prints_nothing(suffix, tmp_path: Path, capfd):
    data = cv2.imencode(suffix, KINDS["color"])[1].tobytes()
    for length in range(0, len(data), 7):
        (tmp_path / "a").write_bytes(data[:length])
        with suppress(DataError):
            read_image(tmp_path / "a")
    assert capfd.readouterr() == ("", "")


def test_chunk_with_a_binary_name_is_one_line():
    with pytest.raises(ValueError, match=r"the checksum of the chunk 'A\\r\\n ' is wrong"):
        strip_png_metadata(with_chunk(encoded(KINDS["gray"]), chunk(b"A\r\n ", b"", wrong=1)))
