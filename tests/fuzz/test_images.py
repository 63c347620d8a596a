"""Damaged images are decoded or refused, and the header agrees with the decoded size."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.scene.images import read_header, read_image
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome

RNG = np.random.default_rng(0)
WORDS = [
    "IHDR",
    "IDAT",
    "PLTE",
    "tRNS",
    "iCCP",
    "eXIf",
    "acTL",
    "fcTL",
    "IEND",
    "Exif\0\0II*\0",
    "II*\0",
    "MM\0*",
    "RIFF",
]


def seeds(suffix: str) -> list[bytes]:
    """Small images of all kinds that a format has."""
    made = []
    for channels, kind in itertools.product((1, 3, 4), (np.uint8, np.uint16)):
        if kind == np.uint16 and suffix not in (".png", ".tif"):
            continue
        pixels = RNG.integers(0, np.iinfo(kind).max, (11, 9, channels)).astype(kind)
        made.append(cv2.imencode(suffix, pixels)[1].tobytes())
    return made


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp"])
def test_damaged_image_is_read_or_refused(suffix, folder: Path):
    @fuzzed(data=damaged(seeds(suffix), WORDS))
    def reads(data):
        path = folder / f"a{suffix}"
        path.write_bytes(data)
        header = outcome(read_header, path)
        pixels = outcome(read_image, path)
        if pixels is not None:
            assert pixels.dtype in (np.uint8, np.uint16)
            assert pixels.shape[2] in (3, 4)
            assert header is not None
        del pixels  # bytes may say 150 million pixels: those of one image are within the bound on memory, of two not
        outcome(read_image, path, True)

    reads()
